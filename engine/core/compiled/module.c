/* The module: functions of fixed arguments over checked arrays. All hold the interpreter's lock but the decoder: each
 * takes some microseconds, and giving the lock away would let another thread keep it for a millisecond. */
#include "arguments.h"

#ifndef SOURCE_DIGEST
#error "SOURCE_DIGEST is defined by setup.py"
#endif

#define FUNCTION(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, NULL}

static PyMethodDef methods[] = {
    FUNCTION(decode_16zt),
    FUNCTION(refine_markers),
    FUNCTION(sample_chroma),
    FUNCTION(look_at_depth),
    FUNCTION(is_gray),
    FUNCTION(look_at_color),
    FUNCTION(changed_cells),
    FUNCTION(scene_blocks),
    FUNCTION(scene_movement),
    FUNCTION(least_squares),
    FUNCTION(cell_means),
    FUNCTION(mean_cells),
    FUNCTION(median_square),
    FUNCTION(largest_mean),
    FUNCTION(marker_places),
    FUNCTION(corner_medians),
    FUNCTION(surface_change),
    FUNCTION(mean_depth),
    FUNCTION(camera_rays),
    FUNCTION(align_nodes),
    FUNCTION(cut_out),
    FUNCTION(project),
    FUNCTION(map_points),
    FUNCTION(node_surface),
    FUNCTION(mesh_volume),
    FUNCTION(depths),
    FUNCTION(largest_difference),
    FUNCTION(shift_correlations),
    FUNCTION(seen_shares),
    FUNCTION(replacer),
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_kernels", "The frame path's functions in C; see engine.core.compiled.", -1, methods,
    NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__kernels(void)
{
    PyObject *module = PyModule_Create(&definition);
    if (module != NULL && PyModule_AddStringConstant(module, "SOURCE_DIGEST", SOURCE_DIGEST) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
