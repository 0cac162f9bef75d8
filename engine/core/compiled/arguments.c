#include "arguments.h"

#include <string.h>

static Py_ssize_t size_of_item(char item)
{
    switch (item) {
    case 'B':
    case '?':
        return 1;
    case 'H':
        return 2;
    case 'f':
        return 4;
    default:
        return 8; /* d, q */
    }
}

static int has_item(const Py_buffer *view, char item)
{
    const char *format = view->format == NULL ? "B" : view->format;
    if (*format == '<' || *format == '=' || *format == '@')
        format++;
    if (strlen(format) != 1 || view->itemsize != size_of_item(item))
        return 0;
    if (item == 'q')
        return *format == 'q' || *format == 'l'; /* numpy's intp */
    return *format == item;
}

enum { ANY_SHAPE = -1, ANY_BYTES = -2 };

static Py_buffer *take(Arrays *arrays, PyObject *object, const char *name, char item, int ndim, int flags)
{
    if (arrays->failed)
        return NULL;
    if (arrays->count >= MOST_ARRAYS) {
        PyErr_SetString(PyExc_SystemError, "too many arrays");
        arrays->failed = 1;
        return NULL;
    }
    Py_buffer *view = &arrays->views[arrays->count];
    if (PyObject_GetBuffer(object, view, flags) < 0) {
        arrays->failed = 1;
        return NULL;
    }
    arrays->count++;
    if (ndim == ANY_BYTES)
        return view;
    if ((ndim != ANY_SHAPE && view->ndim != ndim) || !has_item(view, item) || (uintptr_t)view->buf % (uintptr_t)view->itemsize != 0) {
        PyErr_Format(PyExc_ValueError, "%s must be an aligned array of %d dimensions and items %c, not %d and %s", name,
                     ndim, item, view->ndim, view->format == NULL ? "B" : view->format);
        arrays->failed = 1;
        return NULL;
    }
    return view;
}

Py_buffer *array_of(Arrays *arrays, PyObject *object, const char *name, char item, int ndim)
{
    return take(arrays, object, name, item, ndim, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT);
}

Py_buffer *output_of(Arrays *arrays, PyObject *object, const char *name, char item, int ndim)
{
    return take(arrays, object, name, item, ndim, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | PyBUF_WRITABLE);
}

Py_buffer *values_of(Arrays *arrays, PyObject *object, const char *name, char item)
{
    return take(arrays, object, name, item, ANY_SHAPE, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT);
}

Py_buffer *bytes_of(Arrays *arrays, PyObject *object, const char *name)
{
    return take(arrays, object, name, 'B', ANY_BYTES, PyBUF_SIMPLE);
}

Py_ssize_t whole_of(Arrays *arrays, PyObject *object, const char *name, Py_ssize_t low, Py_ssize_t high)
{
    if (arrays->failed)
        return 0;
    Py_ssize_t value = PyLong_AsSsize_t(object);
    if (value == -1 && PyErr_Occurred()) {
        arrays->failed = 1;
        return 0;
    }
    if (value < low || value > high) {
        PyErr_Format(PyExc_ValueError, "%s must be from %zd to %zd, not %zd", name, low, high, value);
        arrays->failed = 1;
        return 0;
    }
    return value;
}

double number_of(Arrays *arrays, PyObject *object, const char *name)
{
    if (arrays->failed)
        return 0.0;
    double value = PyFloat_AsDouble(object);
    if (value == -1.0 && PyErr_Occurred())
        arrays->failed = 1;
    (void)name;
    return value;
}

void require(Arrays *arrays, int holds, const char *what)
{
    if (arrays->failed || holds)
        return;
    PyErr_SetString(PyExc_ValueError, what);
    arrays->failed = 1;
}

int are_indices(const Py_buffer *view, Py_ssize_t end)
{
    const int64_t *at = view->buf;
    for (Py_ssize_t i = 0; i < view->shape[0]; i++)
        if (at[i] < 0 || at[i] >= end)
            return 0;
    return 1;
}

int counted(Py_ssize_t given, Py_ssize_t wanted, const char *name)
{
    if (given == wanted)
        return 1;
    PyErr_Format(PyExc_TypeError, "%s takes %zd arguments, not %zd", name, wanted, given);
    return 0;
}

PyObject *finish(Arrays *arrays, PyObject *result)
{
    for (int i = 0; i < arrays->count; i++)
        PyBuffer_Release(&arrays->views[i]);
    return arrays->failed ? NULL : Py_NewRef(result);
}

double select_kth(double *values, Py_ssize_t n, Py_ssize_t k)
{
    Py_ssize_t low = 0, high = n - 1;
    while (low < high) {
        double pivot = values[low + (high - low) / 2];
        Py_ssize_t i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (values[j] > pivot)
                j--;
            if (i <= j) {
                double swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        if (k <= j)
            high = j;
        else if (k >= i)
            low = i;
        else
            break;
    }
    return values[k];
}

double median_of(double *values, Py_ssize_t n)
{
    double upper = select_kth(values, n, n / 2);
    if (n % 2)
        return upper;
    /* All before the middle are no larger than it. */
    double lower = values[0];
    for (Py_ssize_t i = 1; i < n / 2; i++)
        lower = values[i] > lower ? values[i] : lower;
    return (lower + upper) / 2.0;
}
