/* Checked arrays from Python: every function takes its arguments through these, and none touches memory before. */
#ifndef TIDEGATE_ARGUMENTS_H
#define TIDEGATE_ARGUMENTS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>

#define MOST_ARRAYS 24

/* On x86-64 with glibc the loader picks the widest vectors that the processor has. No sum is reordered and none is fused
 * (-ffp-contract=off), so all give the same bits. */
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(TIDEGATE_PLAIN)
#if __GNUC__ >= 12
#define WIDE_VECTORS __attribute__((target_clones("arch=x86-64-v4", "avx2", "default")))
#else /* knows no name for AVX-512's usual set */
#define WIDE_VECTORS __attribute__((target_clones("avx2", "default")))
#endif
#else
#define WIDE_VECTORS
#endif

typedef struct {
    Py_buffer views[MOST_ARRAYS];
    int count;
    int failed;
} Arrays;

/* An array of items 'B', '?', 'H', 'f', 'd' or 'q', C-contiguous and aligned, of `ndim` dimensions. NULL and a Python
 * exception otherwise; then `failed` is set, and further calls do nothing. */
Py_buffer *array_of(Arrays *arrays, PyObject *object, const char *name, char item, int ndim);
/* The same for an array that is written to. */
Py_buffer *output_of(Arrays *arrays, PyObject *object, const char *name, char item, int ndim);
/* The same of any shape. */
Py_buffer *values_of(Arrays *arrays, PyObject *object, const char *name, char item);
/* Any contiguous bytes. */
Py_buffer *bytes_of(Arrays *arrays, PyObject *object, const char *name);
/* A number from low to high; 0 and an exception otherwise. */
Py_ssize_t whole_of(Arrays *arrays, PyObject *object, const char *name, Py_ssize_t low, Py_ssize_t high);
double number_of(Arrays *arrays, PyObject *object, const char *name);
/* Raise ValueError unless a condition holds. */
void require(Arrays *arrays, int holds, const char *what);
/* Whether all of an array's items 'q' are from 0 to before `end`. */
int are_indices(const Py_buffer *view, Py_ssize_t end);
/* Raise TypeError unless there are so many arguments; 0 then. */
int counted(Py_ssize_t given, Py_ssize_t wanted, const char *name);
/* Release all arrays; return a new reference to `result`, or NULL if something failed. */
PyObject *finish(Arrays *arrays, PyObject *result);

PyObject *decode_16zt(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *refine_markers(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *sample_chroma(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *look_at_depth(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *look_at_color(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *is_gray(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *scene_blocks(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *scene_movement(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *least_squares(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *cell_means(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *corner_medians(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *surface_change(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *camera_rays(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *changed_cells(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *align_nodes(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *cut_out(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *project(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *map_points(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *node_surface(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *mesh_volume(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *seen_shares(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *median_square(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *mean_cells(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *largest_mean(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *marker_places(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *depths(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *largest_difference(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *mean_depth(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *shift_correlations(PyObject *module, PyObject *const *args, Py_ssize_t count);
PyObject *replacer(PyObject *module, PyObject *const *args, Py_ssize_t count);

/* The k-th smallest of n values, which are reordered; 0 <= k < n, no NaN. */
double select_kth(double *values, Py_ssize_t n, Py_ssize_t k);
/* Mean of the two middle values, or the middle one; n > 0. */
double median_of(double *values, Py_ssize_t n);

#endif
