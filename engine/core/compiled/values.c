/* Frozen values of slots: a copy with some fields changed, as dataclasses.replace makes it. */
#include "arguments.h"

#include <structmember.h>

static int are_slots_of(PyObject *value, PyObject *names, PyObject *slots)
{
    if (!PyTuple_CheckExact(names) || !PyTuple_CheckExact(slots) || PyTuple_GET_SIZE(names) != PyTuple_GET_SIZE(slots))
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(slots); i++) {
        PyObject *slot = PyTuple_GET_ITEM(slots, i);
        if (!Py_IS_TYPE(slot, &PyMemberDescr_Type) || !PyObject_TypeCheck(value, PyDescr_TYPE(slot)))
            return 0;
    }
    return 1;
}

/* The change of a field, NULL where it stays; names are interned. */
static PyObject *changed(PyObject *name, PyObject *const *changes, PyObject *changed_names)
{
    for (Py_ssize_t i = 0; changed_names != NULL && i < PyTuple_GET_SIZE(changed_names); i++) {
        if (PyTuple_GET_ITEM(changed_names, i) == name)
            return changes[i];
    }
    return NULL;
}

/* None where a change names no slot: the constructor then says which. */
static PyObject *copied(PyObject *value, PyObject *names, PyObject *slots, PyObject *const *changes,
                        PyObject *changed_names)
{
    PyObject *copy = Py_TYPE(value)->tp_alloc(Py_TYPE(value), 0);
    Py_ssize_t used = 0;
    for (Py_ssize_t i = 0; copy != NULL && i < PyTuple_GET_SIZE(slots); i++) {
        PyMemberDef *slot = ((PyMemberDescrObject *)PyTuple_GET_ITEM(slots, i))->d_member;
        PyObject *field = changed(PyTuple_GET_ITEM(names, i), changes, changed_names);
        if (field != NULL) {
            Py_INCREF(field);
            used++;
        } else {
            field = PyMember_GetOne((const char *)value, slot);
        }
        if (field == NULL || PyMember_SetOne((char *)copy, slot, field) < 0)
            Py_CLEAR(copy);
        Py_XDECREF(field);
    }
    if (copy == NULL || used == (changed_names == NULL ? 0 : PyTuple_GET_SIZE(changed_names)))
        return copy;
    Py_DECREF(copy);
    Py_RETURN_NONE;
}

static PyObject *replace_in(PyObject *self, PyObject *const *args, Py_ssize_t count, PyObject *changed_names)
{
    PyObject *otherwise = PyTuple_GET_ITEM(self, 1);
    if (count != 1)
        return PyObject_Vectorcall(otherwise, args, (size_t)count, changed_names);
    PyObject *fields = PyDict_GetItemWithError(PyTuple_GET_ITEM(self, 0), (PyObject *)Py_TYPE(args[0]));
    if (fields == NULL)
        return PyErr_Occurred() ? NULL : PyObject_Vectorcall(otherwise, args, 1, changed_names);
    PyObject *names, *slots;
    if (!PyArg_ParseTuple(fields, "OO:replace", &names, &slots))
        return NULL;
    if (!are_slots_of(args[0], names, slots)) {
        PyErr_SetString(PyExc_TypeError, "the fields known of a class are the names of its slots, and these");
        return NULL;
    }
    PyObject *copy = copied(args[0], names, slots, args + 1, changed_names);
    if (copy != Py_None)
        return copy;
    Py_DECREF(copy);
    return PyObject_Vectorcall(otherwise, args, 1, changed_names);
}

static PyMethodDef replace_method = {
    "replace", (PyCFunction)(void (*)(void))replace_in, METH_FASTCALL | METH_KEYWORDS, NULL};

/* A replace(value, **changes) that copies the slots of the classes in a dict, class -> (names, slots), and calls
 * another function for every other. */
PyObject *replacer(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 2, "replacer"))
        return NULL;
    if (!PyDict_CheckExact(args[0]) || !PyCallable_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "replacer takes a dict of classes and a function");
        return NULL;
    }
    PyObject *self = PyTuple_Pack(2, args[0], args[1]);
    PyObject *made = self == NULL ? NULL : PyCFunction_New(&replace_method, self);
    Py_XDECREF(self);
    return made;
}
