/* What follows from the coefficients of a frame: the surface at the nodes, its volume, its continuity, what was seen of
 * regions, and how two of them move alike. */
#include "arguments.h"

#include <math.h>
#include <string.h>

/* Points through a homography. */
PyObject *map_points(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 3, "map_points"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *homography = array_of(&arrays, args[0], "homography", 'd', 2);
    Py_buffer *points = array_of(&arrays, args[1], "points", 'd', 2);
    Py_buffer *mapped = output_of(&arrays, args[2], "mapped", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = points->shape[0];
    require(&arrays, homography->shape[0] == 3 && homography->shape[1] == 3, "homography must be 3 by 3");
    require(&arrays, points->shape[1] == 2 && mapped->shape[0] == n && mapped->shape[1] == 2,
            "mapped must be one a point");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *h = homography->buf, *point = points->buf;
    double *target = mapped->buf;
    for (Py_ssize_t i = 0; i < 2 * n; i += 2) {
        double x = point[i], y = point[i + 1], scale = h[6] * x + h[7] * y + h[8];
        target[i] = (h[0] * x + h[1] * y + h[2]) / scale;
        target[i + 1] = (h[3] * x + h[4] * y + h[5]) / scale;
    }
    return finish(&arrays, Py_None);
}

/* `target` becomes what lies between `inner` (0) and itself (1). Not inlined: GCC 12 makes vectors of the loop over the
 * rows that read one row beyond the last, which is beyond the array. */
__attribute__((noinline)) static void draw_in(const double *inner, double *target, double share)
{
    for (int i = 0; i < 2; i++)
        target[i] = (1.0 - share) * inner[i] + share * target[i];
}

/* Points at a depth on the nodes' rays, the last row and column of which are moved inwards first. */
PyObject *node_surface(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 5, "node_surface"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *rays = array_of(&arrays, args[0], "rays", 'd', 2);
    Py_buffer *depth = array_of(&arrays, args[1], "depth_mm", 'd', 1);
    Py_ssize_t columns = whole_of(&arrays, args[2], "columns", 2, 4096);
    double share = number_of(&arrays, args[3], "share");
    Py_buffer *vertices = output_of(&arrays, args[4], "vertices_mm", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = rays->shape[0], rows = n / columns;
    require(&arrays, rays->shape[1] == 2 && n % columns == 0 && rows >= 2, "rays must be two rows of columns or more");
    require(&arrays, depth->shape[0] == n && vertices->shape[0] == n && vertices->shape[1] == 3,
            "depth_mm and vertices_mm must be one a ray");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    double *target = vertices->buf;
    for (Py_ssize_t i = 0; i < n; i++)
        memcpy(target + 3 * i, (const double *)rays->buf + 2 * i, 2 * sizeof *target);
    for (Py_ssize_t column = 0; column < columns; column++) {
        double *last = target + 3 * ((rows - 1) * columns + column);
        draw_in(last - 3 * columns, last, share);
    }
    for (Py_ssize_t row = 0; row < rows; row++) {
        double *last = target + 3 * (row * columns + columns - 1);
        draw_in(last - 3, last, share);
    }
    for (Py_ssize_t i = 0; i < n; i++) {
        double z = ((const double *)depth->buf)[i];
        target[3 * i] *= z;
        target[3 * i + 1] *= z;
        target[3 * i + 2] = z;
    }
    return finish(&arrays, Py_None);
}

/* Volume between a mesh and a plane at a depth, positive in front of the plane [mm^3]. */
PyObject *mesh_volume(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 3, "mesh_volume"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *vertices = array_of(&arrays, args[0], "vertices_mm", 'd', 2);
    Py_buffer *triangles = array_of(&arrays, args[1], "triangles", 'q', 2);
    double plane = number_of(&arrays, args[2], "plane_mm");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = vertices->shape[0], faces = triangles->shape[0];
    require(&arrays, vertices->shape[1] == 3 && triangles->shape[1] == 3, "vertices_mm and triangles must be triples");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const int64_t *corner = triangles->buf;
    const double *points = vertices->buf;
    double volume = 0.0;
    for (Py_ssize_t face = 0; face < faces; face++) {
        const double *at[3];
        for (int i = 0; i < 3; i++) {
            int64_t index = corner[3 * face + i];
            require(&arrays, index >= 0 && index < n, "every corner must be a vertex");
            if (arrays.failed)
                return finish(&arrays, Py_None);
            at[i] = points + 3 * index;
        }
        const double *a = at[0], *b = at[1], *c = at[2];
        double area = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]));
        volume += area * (plane - (a[2] + b[2] + c[2]) / 3.0);
    }
    PyObject *result = PyFloat_FromDouble(volume);
    PyObject *finished = finish(&arrays, result == NULL ? Py_None : result);
    Py_XDECREF(result);
    if (result == NULL)
        Py_CLEAR(finished);
    return finished;
}

#define LANES 8

WIDE_VECTORS static double product_of(const double *a, const double *b, Py_ssize_t n)
{
    double sums[LANES] = {0.0};
    Py_ssize_t i = 0;
    for (; i + LANES <= n; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            sums[lane] += a[i + lane] * b[i + lane];
    for (; i < n; i++)
        sums[0] += a[i] * b[i];
    for (int half = LANES / 2; half > 0; half /= 2)
        for (int lane = 0; lane < half; lane++)
            sums[lane] += sums[lane + half];
    return sums[0];
}

WIDE_VECTORS static void add_scaled(double *target, const double *values, double scale, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        target[i] += scale * values[i];
}

/* The depth that some coefficients stand for, at the nodes and of the regions; NaN of regions that are not known. */
PyObject *depths(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 8, "depths"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *coefficients = array_of(&arrays, args[0], "coefficients", 'd', 1);
    Py_buffer *node_mean = array_of(&arrays, args[1], "node_mean_mm", 'd', 1);
    Py_buffer *node_modes = array_of(&arrays, args[2], "node_modes", 'd', 2);
    Py_buffer *region_mean = array_of(&arrays, args[3], "region_mean_mm", 'd', 1);
    Py_buffer *region_modes = array_of(&arrays, args[4], "region_modes", 'd', 2);
    Py_buffer *is_known = array_of(&arrays, args[5], "is_known", '?', 1);
    Py_buffer *nodes = output_of(&arrays, args[6], "nodes_mm", 'd', 1);
    Py_buffer *regions = output_of(&arrays, args[7], "regions_mm", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t k = coefficients->shape[0], n = nodes->shape[0], m = regions->shape[0];
    require(&arrays, node_modes->shape[0] == k && node_modes->shape[1] == n && node_mean->shape[0] == n,
            "node_modes must be one a coefficient and node");
    require(&arrays, region_modes->shape[0] == m && region_modes->shape[1] == k && region_mean->shape[0] == m,
            "region_modes must be one a region and coefficient");
    require(&arrays, is_known->shape[0] == m, "is_known must be one a region");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *weights = coefficients->buf, *modes = node_modes->buf;
    double *target = nodes->buf;
    memset(target, 0, (size_t)nodes->len);
    for (Py_ssize_t j = 0; j < k; j++)
        add_scaled(target, modes + j * n, weights[j], n);
    add_scaled(target, node_mean->buf, 1.0, n);
    for (Py_ssize_t i = 0; i < m; i++) {
        double depth = product_of((const double *)region_modes->buf + i * k, weights, k);
        ((double *)regions->buf)[i] =
            ((const uint8_t *)is_known->buf)[i] ? ((const double *)region_mean->buf)[i] + depth : (double)NAN;
    }
    return finish(&arrays, Py_None);
}

/* Largest difference of two arrays' values; NaN where one of them is no finite number. */
PyObject *largest_difference(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 2, "largest_difference"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *one = values_of(&arrays, args[0], "one", 'd');
    Py_buffer *other = values_of(&arrays, args[1], "other", 'd');
    if (arrays.failed)
        return finish(&arrays, Py_None);
    int is_alike = one->ndim == other->ndim;
    for (int i = 0; is_alike && i < one->ndim; i++)
        is_alike = one->shape[i] == other->shape[i];
    require(&arrays, is_alike, "both must be of one shape");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    double largest = 0.0;
    int is_finite = 1;
    for (Py_ssize_t i = 0; i < one->len / (Py_ssize_t)sizeof(double); i++) {
        double difference = fabs(((const double *)one->buf)[i] - ((const double *)other->buf)[i]);
        is_finite &= isfinite(difference) != 0;
        largest = difference > largest ? difference : largest;
    }
    PyObject *result = PyFloat_FromDouble(is_finite ? largest : (double)NAN);
    arrays.failed = result == NULL;
    PyObject *finished = finish(&arrays, result == NULL ? Py_None : result);
    Py_XDECREF(result);
    return finished;
}

/* Pearson's correlation of two signals over their overlap, at every shift of the first; 0 where one does not vary. */
PyObject *shift_correlations(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 4, "shift_correlations"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *first = array_of(&arrays, args[0], "first", 'd', 1);
    Py_buffer *second = array_of(&arrays, args[1], "second", 'd', 1);
    double least_variance = number_of(&arrays, args[2], "least_variance");
    Py_buffer *correlations = output_of(&arrays, args[3], "correlations", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = first->shape[0];
    require(&arrays, n > 0 && second->shape[0] == n, "both signals must be of one length");
    require(&arrays, correlations->shape[0] == 2 * n - 1, "correlations must be one a shift");
    require(&arrays, least_variance > 0.0, "least_variance must be positive");
    double *sums = arrays.failed ? NULL : PyMem_Malloc((size_t)(4 * (n + 1)) * sizeof *sums);
    if (sums == NULL && !arrays.failed) {
        PyErr_NoMemory();
        arrays.failed = 1;
    }
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *a = first->buf, *b = second->buf;
    double *of_a = sums, *of_aa = sums + n + 1, *of_b = sums + 2 * (n + 1), *of_bb = sums + 3 * (n + 1);
    of_a[0] = of_aa[0] = of_b[0] = of_bb[0] = 0.0;
    for (Py_ssize_t i = 0; i < n; i++) {
        of_a[i + 1] = of_a[i] + a[i];
        of_aa[i + 1] = of_aa[i] + a[i] * a[i];
        of_b[i + 1] = of_b[i] + b[i];
        of_bb[i + 1] = of_bb[i] + b[i] * b[i];
    }
    for (Py_ssize_t shift = 1 - n; shift < n; shift++) {
        Py_ssize_t overlap = n - (shift < 0 ? -shift : shift), from = shift < 0 ? 0 : shift, to = shift < 0 ? -shift : 0;
        double size = (double)overlap, sum_a = of_a[from + overlap] - of_a[from];
        double sum_b = of_b[to + overlap] - of_b[to];
        double variance_a = of_aa[from + overlap] - of_aa[from] - sum_a * sum_a / size;
        double variance_b = of_bb[to + overlap] - of_bb[to] - sum_b * sum_b / size, variances = variance_a * variance_b;
        double covariance = product_of(a + from, b + to, overlap) - sum_a * sum_b / size;
        ((double *)correlations->buf)[shift + n - 1] = variances > least_variance ? covariance / sqrt(variances) : 0.0;
    }
    PyMem_Free(sums);
    return finish(&arrays, Py_None);
}

#define MOST_ALONG 256

/* Sum of the weights of the seen points in four sums, added at the end: the same bits on every processor. */
WIDE_VECTORS static float weight_seen(const float *weights, const uint8_t *is_seen, Py_ssize_t n)
{
    float sums[16] = {0.0f};
    Py_ssize_t i = 0;
    for (; i + 16 <= n; i += 16)
        for (int lane = 0; lane < 16; lane++)
            sums[lane] += is_seen[i + lane] ? weights[i + lane] : 0.0f;
    for (; i < n; i++)
        sums[0] += is_seen[i] ? weights[i] : 0.0f;
    for (int half = 8; half > 0; half /= 2)
        for (int lane = 0; lane < half; lane++)
            sums[lane] += sums[lane + half];
    return sums[0];
}

/* Sum the columns' weights in each cell over the seen columns, or over all of them. */
static void row_weights(const float *weights, const uint8_t *is_seen, Py_ssize_t columns, Py_ssize_t cells, float *sums)
{
    memset(sums, 0, (size_t)cells * sizeof *sums);
    for (Py_ssize_t column = 0; column < columns; column++)
        if (is_seen == NULL || is_seen[column])
            for (Py_ssize_t cell = 0; cell < cells; cell++)
                sums[cell] += weights[column * cells + cell];
}

/* Share of each region that was seen: of cells by separable weights, of the others by a weight for each point. */
PyObject *seen_shares(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 6, "seen_shares"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *seen = array_of(&arrays, args[0], "is_seen", '?', 2);
    Py_buffer *of_rows = array_of(&arrays, args[1], "rows", 'f', 2);
    Py_buffer *of_columns = array_of(&arrays, args[2], "columns", 'f', 2);
    Py_buffer *others = array_of(&arrays, args[3], "others", 'f', 2);
    double steps = number_of(&arrays, args[4], "steps");
    Py_buffer *shares = output_of(&arrays, args[5], "shares", 'f', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = seen->shape[0], columns = seen->shape[1];
    Py_ssize_t cell_rows = of_rows->shape[0], cell_columns = of_columns->shape[1];
    require(&arrays, of_rows->shape[1] == rows && of_columns->shape[0] == columns, "weights must be one a point");
    require(&arrays, others->shape[1] == rows * columns, "others must be one a point");
    require(&arrays, cell_rows <= MOST_ALONG && cell_columns <= MOST_ALONG, "too many cells");
    if (!arrays.failed)
        require(&arrays, shares->shape[0] == cell_rows * cell_columns + others->shape[0], "shares must be one a region");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t cells = cell_rows * cell_columns;
    float *share = shares->buf;
    const uint8_t *is_seen = seen->buf;
    memset(share, 0, (size_t)shares->len);
    float all[MOST_ALONG], some[MOST_ALONG]; /* of a row that is seen wholly, as most are, and of another */
    row_weights(of_columns->buf, NULL, columns, cell_columns, all);
    for (Py_ssize_t row = 0; row < rows; row++) {
        const uint8_t *is_row_seen = is_seen + row * columns;
        const float *line = all;
        if (memchr(is_row_seen, 0, (size_t)columns) != NULL) {
            row_weights(of_columns->buf, is_row_seen, columns, cell_columns, some);
            line = some;
        }
        for (Py_ssize_t cell_row = 0; cell_row < cell_rows; cell_row++) {
            float weight = ((const float *)of_rows->buf)[cell_row * rows + row];
            if (weight != 0.0f) /* a row lies in one cell, or in two */
                for (Py_ssize_t cell = 0; cell < cell_columns; cell++)
                    share[cell_row * cell_columns + cell] += weight * line[cell];
        }
    }
    for (Py_ssize_t other = 0; other < others->shape[0]; other++)
        share[cells + other] = weight_seen((const float *)others->buf + other * rows * columns, is_seen, rows * columns);
    for (Py_ssize_t i = 0; i < shares->shape[0]; i++) { /* so that all of a region is 1 */
        float rounded = rintf(share[i] * (float)steps) / (float)steps;
        share[i] = rounded < 0.0f ? 0.0f : rounded > 1.0f ? 1.0f : rounded;
    }
    return finish(&arrays, Py_None);
}
