/* Small sums and fits over the region's surface. */
#include "arguments.h"

#include <math.h>
#include <string.h>

static PyObject *out_of_memory(Arrays *arrays)
{
    PyErr_NoMemory();
    arrays->failed = 1;
    return finish(arrays, Py_None);
}

static int are_cells(const Py_buffer *view, Py_ssize_t size, Py_ssize_t cells)
{
    const int64_t *at = view->buf;
    if (view->shape[0] != size)
        return 0;
    for (Py_ssize_t i = 0; i < size; i++)
        if (at[i] < 0 || at[i] >= cells)
            return 0;
    return 1;
}

#define MOST_CELLS 4096

PyObject *cell_means(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 6, "cell_means"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *depth = array_of(&arrays, args[0], "depth_mm", 'f', 2);
    Py_buffer *valid = array_of(&arrays, args[1], "valid", '?', 2);
    Py_buffer *cell_of_row = array_of(&arrays, args[2], "cell_of_row", 'q', 1);
    Py_buffer *cell_of_column = array_of(&arrays, args[3], "cell_of_column", 'q', 1);
    Py_buffer *least = array_of(&arrays, args[4], "least_seen", 'd', 2);
    Py_buffer *means = output_of(&arrays, args[5], "means_mm", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = depth->shape[0], columns = depth->shape[1];
    Py_ssize_t cell_rows = means->shape[0], cell_columns = means->shape[1];
    require(&arrays, valid->shape[0] == rows && valid->shape[1] == columns, "valid must be as large as depth_mm");
    require(&arrays, least->shape[0] == cell_rows && least->shape[1] == cell_columns, "least_seen must be one a cell");
    require(&arrays, cell_rows <= MOST_CELLS && cell_columns <= MOST_CELLS && cell_rows * cell_columns <= MOST_CELLS,
            "too many cells");
    if (!arrays.failed)
        require(&arrays, are_cells(cell_of_row, rows, cell_rows) && are_cells(cell_of_column, columns, cell_columns),
                "every row and column must be of a cell");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    int counts[MOST_CELLS] = {0};
    double *sums = means->buf;
    memset(sums, 0, (size_t)means->len);
    for (Py_ssize_t row = 0; row < rows; row++) {
        const float *line = (const float *)depth->buf + row * columns;
        const uint8_t *is_valid = (const uint8_t *)valid->buf + row * columns;
        Py_ssize_t first = ((const int64_t *)cell_of_row->buf)[row] * cell_columns;
        const int64_t *cell_at = cell_of_column->buf;
        for (Py_ssize_t column = 0; column < columns;) {
            Py_ssize_t cell = cell_at[column];
            double sum = 0.0;
            int seen = 0;
            for (; column < columns && cell_at[column] == cell; column++) {
                sum += is_valid[column] ? (double)line[column] : 0.0;
                seen += is_valid[column] != 0;
            }
            sums[first + cell] += sum;
            counts[first + cell] += seen;
        }
    }
    for (Py_ssize_t cell = 0; cell < cell_rows * cell_columns; cell++)
        sums[cell] = (double)counts[cell] >= ((const double *)least->buf)[cell]
                         ? sums[cell] / (counts[cell] > 1 ? (double)counts[cell] : 1.0)
                         : (double)NAN;
    return finish(&arrays, Py_None);
}

/* A number as a new Python object, in place of None; NULL where something failed. */
static PyObject *finish_number(Arrays *arrays, double number)
{
    PyObject *result = arrays->failed ? NULL : PyFloat_FromDouble(number);
    arrays->failed |= result == NULL;
    PyObject *finished = finish(arrays, result == NULL ? Py_None : result);
    Py_XDECREF(result);
    return finished;
}

#define MOST_FRAMES 64

/* Take the arrays of a list, one a frame, all of one length; their number, 0 and an exception where they are not such. */
static Py_ssize_t frames_of(Arrays *arrays, PyObject *list, const char *name, Py_buffer *frames, Py_ssize_t *size)
{
    Py_ssize_t n = PyList_CheckExact(list) ? PyList_GET_SIZE(list) : 0;
    if (n < 1 || n > MOST_FRAMES) {
        PyErr_Format(PyExc_ValueError, "%s must be a list of 1 to %d arrays", name, MOST_FRAMES);
        arrays->failed = 1;
        return 0;
    }
    for (Py_ssize_t i = 0; i < n; i++) {
        Arrays one = {0};
        Py_buffer *view = array_of(&one, PyList_GET_ITEM(list, i), name, 'd', 1);
        if (!one.failed)
            require(&one, i == 0 || view->shape[0] == *size, "all must be of one length");
        if (one.failed) {
            Py_XDECREF(finish(&one, Py_None));
            for (Py_ssize_t taken = 0; taken < i; taken++)
                PyBuffer_Release(&frames[taken]);
            arrays->failed = 1;
            return 0;
        }
        *size = view->shape[0];
        frames[i] = *view;
    }
    return n;
}

/* Mean of each cell over the frames that saw it; NaN where fewer than half of them did. */
PyObject *mean_cells(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 2, "mean_cells"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer frames[MOST_FRAMES];
    Py_ssize_t size = 0, n = frames_of(&arrays, args[0], "cells_mm", frames, &size);
    Py_buffer *mean = output_of(&arrays, args[1], "mean_mm", 'd', 1);
    if (!arrays.failed)
        require(&arrays, mean->shape[0] == size, "mean_mm must be one a cell");
    if (!arrays.failed)
        for (Py_ssize_t cell = 0; cell < size; cell++) {
            double sum = 0.0;
            Py_ssize_t seen = 0;
            for (Py_ssize_t i = 0; i < n; i++) {
                double value = ((const double *)frames[i].buf)[cell];
                if (isfinite(value)) {
                    sum += value;
                    seen++;
                }
            }
            ((double *)mean->buf)[cell] = 2 * seen >= n ? sum / (double)seen : (double)NAN;
        }
    for (Py_ssize_t i = 0; i < n; i++)
        PyBuffer_Release(&frames[i]);
    return finish(&arrays, Py_None);
}

/* Largest mean of any place over the frames that saw it, regardless of its sign; NaN where no frame saw one. */
PyObject *largest_mean(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 1, "largest_mean"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer frames[MOST_FRAMES];
    Py_ssize_t size = 0, n = frames_of(&arrays, args[0], "changes_mm", frames, &size);
    double largest = 0.0;
    for (Py_ssize_t at = 0; n > 0 && at < size; at++) {
        double sum = 0.0;
        Py_ssize_t seen = 0;
        for (Py_ssize_t i = 0; i < n; i++) {
            double change = ((const double *)frames[i].buf)[at];
            sum += isfinite(change) ? change : 0.0;
            seen += isfinite(change) != 0;
        }
        if (seen == 0) {
            largest = (double)NAN;
            break;
        }
        double mean = fabs(sum / (double)seen);
        largest = mean > largest ? mean : largest;
    }
    for (Py_ssize_t i = 0; i < n; i++)
        PyBuffer_Release(&frames[i]);
    return finish_number(&arrays, largest);
}

/* The markers' places at a depth, a percentile of the cells', and the same in another camera's frame; false where they
 * are not known. */
PyObject *marker_places(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 7, "marker_places"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *cells = array_of(&arrays, args[0], "cells_mm", 'd', 1);
    double percentile = number_of(&arrays, args[1], "percentile");
    Py_buffer *rays = array_of(&arrays, args[2], "rays", 'd', 2);
    Py_buffer *rotation = array_of(&arrays, args[3], "rotation", 'd', 2);
    Py_buffer *translation = array_of(&arrays, args[4], "translation_mm", 'd', 1);
    Py_buffer *places = output_of(&arrays, args[5], "places_mm", 'd', 2);
    Py_buffer *others = output_of(&arrays, args[6], "others_mm", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = rays->shape[0], known = 0;
    require(&arrays, cells->shape[0] <= MOST_CELLS, "too many cells");
    require(&arrays, percentile >= 0.0 && percentile <= 100.0, "percentile must be from 0 to 100");
    require(&arrays, rays->shape[1] == 3, "rays must be triples");
    require(&arrays, rotation->shape[0] == 3 && rotation->shape[1] == 3 && translation->shape[0] == 3,
            "rotation must be 3 by 3, translation_mm 3");
    require(&arrays, places->shape[0] == n && places->shape[1] == 3 && others->shape[0] == n && others->shape[1] == 3,
            "places_mm and others_mm must be triples, one for each ray");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    double seen[MOST_CELLS], depth = (double)NAN;
    for (Py_ssize_t i = 0; i < cells->shape[0]; i++) {
        double cell = ((const double *)cells->buf)[i];
        if (isfinite(cell))
            seen[known++] = cell;
    }
    if (known > 0) {
        double at = percentile / 100.0 * (double)(known - 1);
        Py_ssize_t before = (Py_ssize_t)at, next = before + 1 < known ? before + 1 : known - 1;
        double below = select_kth(seen, known, before), above = select_kth(seen, known, next);
        depth = below + (at - (double)before) * (above - below);
    }
    const double *r = rotation->buf, *t = translation->buf;
    int is_known = 1;
    for (Py_ssize_t i = 0; i < n; i++) {
        double *place = (double *)places->buf + 3 * i, *other = (double *)others->buf + 3 * i;
        for (int j = 0; j < 3; j++) {
            place[j] = ((const double *)rays->buf)[3 * i + j] * depth;
            is_known &= isfinite(place[j]) != 0;
        }
        for (int j = 0; j < 3; j++)
            other[j] = place[0] * r[3 * j] + place[1] * r[3 * j + 1] + place[2] * r[3 * j + 2] + t[j];
    }
    return finish(&arrays, is_known ? Py_True : Py_False);
}

#define LANES 8

/* Sum of the valid readings in eight sums, added at the end, and their number. */
WIDE_VECTORS
static double sum_valid(const float *depth, const uint8_t *valid, Py_ssize_t n, Py_ssize_t *seen)
{
    double sums[LANES] = {0.0};
    int32_t found = 0;
    Py_ssize_t i = 0;
    for (; i + LANES <= n; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            sums[lane] += (double)(valid[i + lane] ? depth[i + lane] : 0.0f);
    for (; i < n; i++)
        sums[0] += (double)(valid[i] ? depth[i] : 0.0f);
    for (int half = LANES / 2; half > 0; half /= 2)
        for (int lane = 0; lane < half; lane++)
            sums[lane] += sums[lane + half];
    for (i = 0; i < n; i++)
        found += valid[i] != 0;
    *seen = found;
    return sums[0];
}

/* Mean of the valid readings; NaN where there is none. */
PyObject *mean_depth(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 2, "mean_depth"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *depth = array_of(&arrays, args[0], "depth_mm", 'f', 2);
    Py_buffer *valid = array_of(&arrays, args[1], "valid", '?', 2);
    if (!arrays.failed)
        require(&arrays, valid->shape[0] == depth->shape[0] && valid->shape[1] == depth->shape[1],
                "valid must be as large as depth_mm");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t seen = 0;
    double sum = sum_valid(depth->buf, valid->buf, depth->shape[0] * depth->shape[1], &seen);
    return finish_number(&arrays, seen ? sum / (double)seen : (double)NAN);
}

PyObject *corner_medians(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 5, "corner_medians"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *depth = array_of(&arrays, args[0], "depth_mm", 'f', 2);
    Py_buffer *valid = array_of(&arrays, args[1], "valid", '?', 2);
    Py_ssize_t reach = whole_of(&arrays, args[2], "reach", 1, 64);
    Py_ssize_t least = whole_of(&arrays, args[3], "least_readings", 1, 4096);
    Py_buffer *medians = output_of(&arrays, args[4], "medians_mm", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = depth->shape[0], columns = depth->shape[1];
    require(&arrays, valid->shape[0] == rows && valid->shape[1] == columns, "valid must be as large as depth_mm");
    require(&arrays, reach <= rows && reach <= columns, "reach must be within the region");
    require(&arrays, medians->shape[0] == 4, "medians_mm must be four");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    int is_seen = 1;
    for (int corner = 0; corner < 4 && is_seen; corner++) { /* clockwise from superior right */
        Py_ssize_t top = corner < 2 ? 0 : rows - reach, left = corner == 1 || corner == 2 ? columns - reach : 0;
        double readings[64 * 64];
        Py_ssize_t n = 0, unknown = 0;
        for (Py_ssize_t row = top; row < top + reach; row++)
            for (Py_ssize_t column = left; column < left + reach; column++) {
                float reading = ((const float *)depth->buf)[row * columns + column];
                if (!((const uint8_t *)valid->buf)[row * columns + column])
                    continue;
                if (reading == reading)
                    readings[n++] = (double)reading;
                else
                    unknown++;
            }
        is_seen = n + unknown >= least;
        if (is_seen && unknown) {
            ((double *)medians->buf)[corner] = (double)NAN;
        } else if (is_seen) {
            double upper = select_kth(readings, n, n / 2), lower = upper;
            if (n % 2 == 0) {
                lower = readings[0];
                for (Py_ssize_t i = 1; i < n / 2; i++)
                    lower = readings[i] > lower ? readings[i] : lower;
            }
            ((double *)medians->buf)[corner] = (double)(((float)lower + (float)upper) / 2.0f);
        }
    }
    return finish(&arrays, is_seen ? Py_True : Py_False);
}

/* Dot product in four sums, added at the end: the same bits on every processor. */
static double dot(const double *a, const double *b, Py_ssize_t n)
{
    double sums[4] = {0.0, 0.0, 0.0, 0.0};
    Py_ssize_t i = 0;
    for (; i + 4 <= n; i += 4)
        for (int lane = 0; lane < 4; lane++)
            sums[lane] += a[i + lane] * b[i + lane];
    for (; i < n; i++)
        sums[0] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

#define MOST_TERMS 64
#define LEAST_PIVOT 1e-6

/* Householder's reflections of columns of length m, and of the values beside them. 0 where the columns are nearly
 * dependent: what is wanted then is the shortest of many answers, which this does not give. */
static int solve_terms(double *columns, Py_ssize_t k, Py_ssize_t m, double *values, double *weights)
{
    double diagonal[MOST_TERMS];
    for (Py_ssize_t j = 0; j < k; j++) {
        double *column = columns + j * m + j;
        Py_ssize_t rest = m - j;
        double whole = dot(columns + j * m, columns + j * m, m), below = dot(column, column, rest);
        if (!(below > LEAST_PIVOT * LEAST_PIVOT * whole) || !isfinite(whole))
            return 0;
        double length = column[0] > 0.0 ? -sqrt(below) : sqrt(below);
        diagonal[j] = length;
        column[0] -= length; /* the column is now the reflection's axis */
        double scale = 2.0 / dot(column, column, rest);
        for (Py_ssize_t other = j + 1; other <= k; other++) {
            double *target = (other < k ? columns + other * m : values) + j;
            double factor = scale * dot(column, target, rest);
            for (Py_ssize_t i = 0; i < rest; i++)
                target[i] -= factor * column[i];
        }
    }
    for (Py_ssize_t j = k - 1; j >= 0; j--) {
        double sum = values[j];
        for (Py_ssize_t other = j + 1; other < k; other++)
            sum -= columns[other * m + j] * weights[other];
        weights[j] = sum / diagonal[j];
    }
    return 1;
}

PyObject *least_squares(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 3, "least_squares"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *terms = array_of(&arrays, args[0], "terms", 'd', 2);
    Py_buffer *values = array_of(&arrays, args[1], "values", 'd', 1);
    Py_buffer *weights = output_of(&arrays, args[2], "weights", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t k = terms->shape[0], m = terms->shape[1];
    require(&arrays, values->shape[0] == m, "values must be one for each of a term's");
    require(&arrays, weights->shape[0] == k, "weights must be one a term");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    if (k > MOST_TERMS || m < k || k == 0)
        return finish(&arrays, Py_False);
    double *copy = PyMem_Malloc((size_t)((k + 1) * m) * sizeof *copy);
    if (copy == NULL)
        return out_of_memory(&arrays);
    memcpy(copy, terms->buf, (size_t)terms->len);
    memcpy(copy + k * m, values->buf, (size_t)values->len);
    int is_solved = solve_terms(copy, k, m, copy + k * m, weights->buf);
    PyMem_Free(copy);
    return finish(&arrays, is_solved ? Py_True : Py_False);
}

PyObject *align_nodes(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 7, "align_nodes"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *color_rays = array_of(&arrays, args[0], "color_rays", 'd', 2);
    Py_buffer *depth = array_of(&arrays, args[1], "expected_depth_mm", 'd', 1);
    Py_buffer *rotation = array_of(&arrays, args[2], "rotation", 'd', 2);
    Py_buffer *translation = array_of(&arrays, args[3], "translation_mm", 'd', 1);
    Py_buffer *camera = array_of(&arrays, args[4], "camera", 'd', 1);
    Py_buffer *pixels = output_of(&arrays, args[5], "pixels_px", 'd', 2);
    Py_buffer *rays = output_of(&arrays, args[6], "rays", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = color_rays->shape[0];
    require(&arrays, color_rays->shape[1] == 3 && depth->shape[0] == n, "each ray must be of three and have a depth");
    require(&arrays, rotation->shape[0] == 3 && rotation->shape[1] == 3 && translation->shape[0] == 3,
            "rotation must be 3 by 3, translation_mm 3");
    require(&arrays, camera->shape[0] == 9, "camera must be fx, fy, cx, cy, k1, k2, p1, p2, k3");
    require(&arrays, pixels->shape[0] == n && pixels->shape[1] == 2 && rays->shape[0] == n && rays->shape[1] == 2,
            "pixels_px and rays must be pairs, one for each ray");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *r = rotation->buf, *t = translation->buf, *c = camera->buf;
    double fx = c[0], fy = c[1], cx = c[2], cy = c[3], k1 = c[4], k2 = c[5], p1 = c[6], p2 = c[7], k3 = c[8];
    for (Py_ssize_t i = 0; i < n; i++) {
        const double *ray = (const double *)color_rays->buf + 3 * i;
        double direction[3];
        for (int j = 0; j < 3; j++)
            direction[j] = ray[0] * r[3 * j] + ray[1] * r[3 * j + 1] + ray[2] * r[3 * j + 2];
        double along = (((const double *)depth->buf)[i] - t[2]) / direction[2];
        double z = along * direction[2] + t[2];
        double x = (along * direction[0] + t[0]) / z, y = (along * direction[1] + t[1]) / z;
        double r2 = x * x + y * y, radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        double distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        double distorted_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        ((double *)rays->buf)[2 * i] = x;
        ((double *)rays->buf)[2 * i + 1] = y;
        ((double *)pixels->buf)[2 * i] = fx * distorted_x + cx;
        ((double *)pixels->buf)[2 * i + 1] = fy * distorted_y + cy;
    }
    return finish(&arrays, Py_None);
}

/* Root mean square of some terms' weighted sum at the used places. */
static double spread_of(const double *terms, Py_ssize_t n, const double *weights, Py_ssize_t first, Py_ssize_t end,
                        const uint8_t *is_used, Py_ssize_t used)
{
    double sum = 0.0;
    for (Py_ssize_t i = 0; i < n; i++) {
        if (!is_used[i])
            continue;
        double value = 0.0;
        for (Py_ssize_t j = first; j < end; j++)
            value += weights[j] * terms[j * n + i];
        sum += value * value;
    }
    return sqrt(sum / (double)used);
}

/* Fit a change by its first terms and by all of them: the weights of the first, what all of them leave, NaN where it is
 * not known, and the spreads of breathing (the first terms behind the plane's three) and of the last of these. False with
 * too few cells, None where the terms are nearly dependent: for the numpy form. */
PyObject *surface_change(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 7, "surface_change"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *terms = array_of(&arrays, args[0], "terms", 'd', 2);
    Py_buffer *change = array_of(&arrays, args[1], "change_mm", 'd', 1);
    Py_ssize_t first = whole_of(&arrays, args[2], "first_terms", 4, MOST_TERMS);
    Py_ssize_t least = whole_of(&arrays, args[3], "least_cells", 1, MOST_CELLS);
    Py_buffer *weights = output_of(&arrays, args[4], "weights", 'd', 1);
    Py_buffer *misfit = output_of(&arrays, args[5], "misfit_mm", 'd', 1);
    Py_buffer *spreads = output_of(&arrays, args[6], "spreads_mm", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t k = terms->shape[0], n = terms->shape[1], used = 0;
    require(&arrays, k <= MOST_TERMS && first <= k && n <= MOST_CELLS, "too many terms or cells");
    require(&arrays, change->shape[0] == n && misfit->shape[0] == n, "change_mm and misfit_mm must be one a cell");
    require(&arrays, weights->shape[0] == first && spreads->shape[0] == 3, "weights must be one a first term");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *term = terms->buf, *values = change->buf;
    uint8_t is_used[MOST_CELLS];
    for (Py_ssize_t i = 0; i < n; i++) {
        is_used[i] = isfinite(values[i]) != 0;
        for (Py_ssize_t j = 0; j < k; j++)
            is_used[i] &= isfinite(term[j * n + i]) != 0;
        used += is_used[i];
    }
    if (used < least)
        return finish(&arrays, Py_False);
    if (used < k)
        return finish(&arrays, Py_None);
    double all[MOST_TERMS], *copy = PyMem_Malloc((size_t)(2 * (k + 1) * used) * sizeof *copy);
    if (copy == NULL)
        return out_of_memory(&arrays);
    double *again = copy + (k + 1) * used;
    for (Py_ssize_t i = 0, next = 0; i < n; i++)
        if (is_used[i]) {
            for (Py_ssize_t j = 0; j < k; j++)
                copy[j * used + next] = term[j * n + i];
            copy[k * used + next++] = values[i];
        }
    memcpy(again, copy, (size_t)((k + 1) * used) * sizeof *copy);
    int is_solved = solve_terms(copy, k, used, copy + k * used, all) &&
                    solve_terms(again, first, used, again + k * used, weights->buf);
    PyMem_Free(copy);
    if (!is_solved)
        return finish(&arrays, Py_None);
    double squares = 0.0, *spread = spreads->buf;
    for (Py_ssize_t i = 0; i < n; i++) {
        double left = values[i];
        for (Py_ssize_t j = 0; j < k; j++)
            left -= all[j] * term[j * n + i];
        ((double *)misfit->buf)[i] = is_used[i] ? left : (double)NAN;
        squares += is_used[i] ? left * left : 0.0;
    }
    spread[2] = sqrt(squares / (double)used);
    spread[0] = spread_of(term, n, weights->buf, 3, first, is_used, used);
    spread[1] = spread_of(term, n, weights->buf, first - 1, first, is_used, used);
    return finish(&arrays, Py_True);
}

#define MOST_TOGETHER 64

/* Undistort some points, in place. What is beyond what the lens' model describes stays as without distortion. */
WIDE_VECTORS
static void undistort(const double *c, Py_ssize_t n, Py_ssize_t steps, double *x, double *y)
{
    double x0[MOST_TOGETHER], y0[MOST_TOGETHER], is_beyond[MOST_TOGETHER] = {0.0};
    memcpy(x0, x, (size_t)n * sizeof *x);
    memcpy(y0, y, (size_t)n * sizeof *y);
    for (Py_ssize_t step = 0; step < steps; step++)
        for (Py_ssize_t i = 0; i < n; i++) {
            double r2 = x[i] * x[i] + y[i] * y[i], inverse = 1.0 / (1.0 + ((c[8] * r2 + c[5]) * r2 + c[4]) * r2);
            double shift_x = 2.0 * c[6] * x[i] * y[i] + c[7] * (r2 + 2.0 * x[i] * x[i]);
            double shift_y = c[6] * (r2 + 2.0 * y[i] * y[i]) + 2.0 * c[7] * x[i] * y[i];
            is_beyond[i] = inverse < 0.0 ? 1.0 : is_beyond[i];
            x[i] = is_beyond[i] > 0.0 ? x0[i] : (x0[i] - shift_x) * inverse;
            y[i] = is_beyond[i] > 0.0 ? y0[i] : (y0[i] - shift_y) * inverse;
        }
}

/* Undistorted rays of unit depth, by so many steps of the fixed point that OpenCV iterates too. */
PyObject *camera_rays(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 4, "camera_rays"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *pixels = array_of(&arrays, args[0], "pixels_px", 'd', 2);
    Py_buffer *camera = array_of(&arrays, args[1], "camera", 'd', 1);
    Py_ssize_t steps = whole_of(&arrays, args[2], "steps", 0, 1000);
    Py_buffer *rays = output_of(&arrays, args[3], "rays", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = pixels->shape[0];
    require(&arrays, pixels->shape[1] == 2 && rays->shape[0] == n && rays->shape[1] == 3, "rays must be one a pixel");
    require(&arrays, camera->shape[0] == 9, "camera must be fx, fy, cx, cy, k1, k2, p1, p2, k3");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *c = camera->buf;
    for (Py_ssize_t begin = 0; begin < n; begin += MOST_TOGETHER) {
        double x[MOST_TOGETHER], y[MOST_TOGETHER];
        Py_ssize_t together = n - begin < MOST_TOGETHER ? n - begin : MOST_TOGETHER;
        for (Py_ssize_t i = 0; i < together; i++) {
            const double *pixel = (const double *)pixels->buf + 2 * (begin + i);
            x[i] = (pixel[0] - c[2]) / c[0];
            y[i] = (pixel[1] - c[3]) / c[1];
        }
        undistort(c, together, steps, x, y);
        for (Py_ssize_t i = 0; i < together; i++) {
            double *ray = (double *)rays->buf + 3 * (begin + i);
            ray[0] = x[i];
            ray[1] = y[i];
            ray[2] = 1.0;
        }
    }
    return finish(&arrays, Py_None);
}

/* Whether a pixel is 1 after erosion, or after dilation, by a square from `before` pixels up and left to `behind` down and
 * right; beyond the edge nothing counts. */
static void eroded_or_dilated(const uint8_t *source, Py_ssize_t rows, Py_ssize_t columns, Py_ssize_t before,
                              Py_ssize_t behind, int is_dilated, uint8_t *target)
{
    for (Py_ssize_t row = 0; row < rows; row++)
        for (Py_ssize_t column = 0; column < columns; column++) {
            uint8_t found = (uint8_t)!is_dilated;
            for (Py_ssize_t y = row - before; y <= row + behind; y++)
                for (Py_ssize_t x = column - before; x <= column + behind; x++)
                    if (y >= 0 && x >= 0 && y < rows && x < columns && source[y * columns + x] == is_dilated)
                        found = (uint8_t)is_dilated;
            target[row * columns + column] = found;
        }
}

/* Mark all cells of each block in which more than half of the cells differ in the same direction by more than a limit. */
static int mark_blocks(const float *then, const float *present, Py_ssize_t rows, Py_ssize_t columns, Py_ssize_t block_rows,
                       Py_ssize_t block_columns, float most, uint8_t *other)
{
    int is_any = 0;
    for (Py_ssize_t top = 0; top + block_rows <= rows; top += block_rows)
        for (Py_ssize_t left = 0; left + block_columns <= columns; left += block_columns) {
            Py_ssize_t more[2] = {0, 0}, less[2] = {0, 0}, half = block_rows * block_columns / 2;
            for (Py_ssize_t row = top; row < top + block_rows; row++)
                for (Py_ssize_t at = 2 * (row * columns + left); at < 2 * (row * columns + left + block_columns); at++) {
                    float change = present[at] - then[at];
                    more[at % 2] += change > most;
                    less[at % 2] += change < -most;
                }
            if (more[0] <= half && more[1] <= half && less[0] <= half && less[1] <= half)
                continue;
            is_any = 1;
            for (Py_ssize_t row = top; row < top + block_rows; row++)
                for (Py_ssize_t column = left; column < left + block_columns; column++)
                    other[row * columns + column] = 1;
        }
    return is_any;
}

/* Take the present colours into the newest known ones, NaN being none; return how many cells now have another colour than
 * before, by themselves or as a block, after an opening by a square that leaves lines out. */
PyObject *changed_cells(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 9, "changed_cells"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *before = array_of(&arrays, args[0], "before", 'f', 2);
    Py_buffer *now = array_of(&arrays, args[1], "now", 'f', 2);
    Py_buffer *newest = output_of(&arrays, args[2], "newest", 'f', 2);
    Py_ssize_t columns = whole_of(&arrays, args[3], "columns", 1, MOST_CELLS);
    Py_ssize_t side = whole_of(&arrays, args[4], "side", 1, 64);
    double limit = number_of(&arrays, args[5], "limit");
    Py_ssize_t block_rows = whole_of(&arrays, args[6], "block_rows", 1, MOST_CELLS);
    Py_ssize_t block_columns = whole_of(&arrays, args[7], "block_columns", 1, MOST_CELLS);
    double block_limit = number_of(&arrays, args[8], "block_limit");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = before->shape[0], rows = n / columns, changed = 0, colored = 0, dark = 0;
    require(&arrays, n <= MOST_CELLS && n % columns == 0 && now->shape[0] == n, "cells must be of whole rows");
    require(&arrays, before->shape[1] == 2 && now->shape[1] == 2, "colours must be pairs");
    require(&arrays, newest->shape[0] == n && newest->shape[1] == 2, "newest must be one a cell");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    uint8_t other[MOST_CELLS], eroded[MOST_CELLS], opened[MOST_CELLS];
    const float *then = before->buf;
    float most = (float)limit, *present = newest->buf;
    for (Py_ssize_t i = 0; i < 2 * n; i++) {
        float value = ((const float *)now->buf)[i];
        present[i] = isfinite(value) ? value : present[i];
    }
    int is_any = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        int had_color = isfinite(then[2 * i]), has_color = isfinite(((const float *)now->buf)[2 * i]);
        colored += had_color && has_color;
        dark += had_color && !has_color;
        float red = fabsf(present[2 * i] - then[2 * i]), green = fabsf(present[2 * i + 1] - then[2 * i + 1]);
        other[i] = (red > most || green > most) && red == red && green == green;
        is_any |= other[i];
    }
    is_any |= mark_blocks(then, present, rows, columns, block_rows, block_columns, (float)block_limit, other);
    if (is_any) {
        eroded_or_dilated(other, rows, columns, side / 2, side - 1 - side / 2, 0, eroded);
        eroded_or_dilated(eroded, rows, columns, side / 2, side - 1 - side / 2, 1, opened);
        for (Py_ssize_t i = 0; i < n; i++)
            changed += opened[i];
    }
    PyObject *result = arrays.failed ? NULL : Py_BuildValue("nnn", changed, colored, dark);
    PyObject *given = finish(&arrays, result == NULL ? Py_None : result);
    Py_XDECREF(result);
    return given;
}

/* Median square of the second difference of three frames' cells; NaN where none was seen in all. */
PyObject *median_square(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 3, "median_square"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *first = array_of(&arrays, args[0], "first_mm", 'd', 1);
    Py_buffer *second = array_of(&arrays, args[1], "second_mm", 'd', 1);
    Py_buffer *third = array_of(&arrays, args[2], "third_mm", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = first->shape[0], seen = 0;
    require(&arrays, second->shape[0] == n && third->shape[0] == n, "three frames must have as many cells");
    double *squares = arrays.failed ? NULL : PyMem_Malloc((size_t)(n + 1) * sizeof *squares);
    if (squares == NULL && !arrays.failed) {
        PyErr_NoMemory();
        arrays.failed = 1;
    }
    if (arrays.failed)
        return finish(&arrays, Py_None);
    for (Py_ssize_t i = 0; i < n; i++) {
        double change = ((double *)third->buf)[i] - 2.0 * ((double *)second->buf)[i] + ((double *)first->buf)[i];
        if (isfinite(change))
            squares[seen++] = change * change;
    }
    double median = seen ? median_of(squares, seen) : (double)NAN;
    PyMem_Free(squares);
    PyObject *value = PyFloat_FromDouble(median);
    PyObject *result = finish(&arrays, value == NULL ? Py_None : value);
    Py_XDECREF(value);
    return result;
}
