/* Frozen values of slots: a copy with some fields changed, as dataclasses.replace makes it. */
#include "arguments.h"

#include <structmember.h>

static int are_slots_of(PyObject *value, PyObject *names, PyObject *slots, PyObject *changes)
{
    if (!PyTuple_CheckExact(names) || !PyTuple_CheckExact(slots) || !PyDict_CheckExact(changes) ||
        PyTuple_GET_SIZE(names) != PyTuple_GET_SIZE(slots))
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(slots); i++) {
        PyObject *slot = PyTuple_GET_ITEM(slots, i);
        if (!Py_IS_TYPE(slot, &PyMemberDescr_Type) || !PyObject_TypeCheck(value, PyDescr_TYPE(slot)))
            return 0;
    }
    return 1;
}

/* None where a change names no slot: the constructor then says which. */
PyObject *replaced(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 4, "replaced"))
        return NULL;
    PyObject *value = args[0], *names = args[1], *slots = args[2], *changes = args[3];
    if (!are_slots_of(value, names, slots, changes)) {
        PyErr_SetString(PyExc_TypeError, "replaced takes a value, the names of its slots, these, and a dict");
        return NULL;
    }
    PyObject *copy = Py_TYPE(value)->tp_alloc(Py_TYPE(value), 0);
    Py_ssize_t used = 0;
    for (Py_ssize_t i = 0; copy != NULL && i < PyTuple_GET_SIZE(slots); i++) {
        PyMemberDef *slot = ((PyMemberDescrObject *)PyTuple_GET_ITEM(slots, i))->d_member;
        PyObject *field = PyDict_GetItemWithError(changes, PyTuple_GET_ITEM(names, i));
        if (field != NULL) {
            Py_INCREF(field);
            used++;
        } else if (!PyErr_Occurred()) {
            field = PyMember_GetOne((const char *)value, slot);
        }
        if (field == NULL || PyMember_SetOne((char *)copy, slot, field) < 0)
            Py_CLEAR(copy);
        Py_XDECREF(field);
    }
    if (copy == NULL || used == PyDict_GET_SIZE(changes))
        return copy;
    Py_DECREF(copy);
    Py_RETURN_NONE;
}
