/* The scene beside the patient: depth in blocks, and a plane through their change. */
#include "arguments.h"

#include <math.h>
#include <string.h>

#define MOST_COLUMNS 4096

/* Sums of readings and numbers of holes down the rows of blocks, for each column. */
WIDE_VECTORS
static void sum_rows(const uint16_t *depth, Py_ssize_t columns, Py_ssize_t rows, uint32_t *sums, uint32_t *holes)
{
    memset(sums, 0, (size_t)columns * sizeof *sums);
    memset(holes, 0, (size_t)columns * sizeof *holes);
    for (Py_ssize_t row = 0; row < rows; row++)
        for (Py_ssize_t column = 0; column < columns; column++) {
            uint32_t reading = depth[row * columns + column];
            sums[column] += reading;
            holes[column] += reading == 0;
        }
}

/* Mean of each block's readings; NaN where one is missing. */
PyObject *scene_blocks(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 3, "scene_blocks"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *depth = array_of(&arrays, args[0], "depth_mm", 'H', 2);
    Py_ssize_t block = whole_of(&arrays, args[1], "block", 1, 256);
    Py_buffer *means = output_of(&arrays, args[2], "blocks_mm", 'd', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t columns = depth->shape[1];
    require(&arrays, columns <= MOST_COLUMNS, "depth_mm must have 4096 columns or fewer");
    require(&arrays, means->shape[0] == depth->shape[0] / block && means->shape[1] == columns / block,
            "blocks_mm must be one for each whole block");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    uint32_t sums[MOST_COLUMNS], holes[MOST_COLUMNS];
    double *mean = means->buf;
    for (Py_ssize_t row = 0; row < means->shape[0]; row++) {
        sum_rows((const uint16_t *)depth->buf + row * block * columns, columns, block, sums, holes);
        for (Py_ssize_t column = 0; column < means->shape[1]; column++) {
            uint32_t sum = 0, missing = 0;
            for (Py_ssize_t i = column * block; i < (column + 1) * block; i++) {
                sum += sums[i];
                missing += holes[i];
            }
            *mean++ = missing ? (double)NAN : (double)((float)sum / (float)(block * block));
        }
    }
    return finish(&arrays, Py_None);
}

/* Gauss with pivots; 0 where the matrix is singular. */
static int solve_three(double a[3][4], double *answer)
{
    for (int j = 0; j < 3; j++) {
        int pivot = j;
        for (int i = j + 1; i < 3; i++)
            if (fabs(a[i][j]) > fabs(a[pivot][j]))
                pivot = i;
        if (!(fabs(a[pivot][j]) > 0.0))
            return 0;
        for (int i = 0; i < 4; i++) {
            double swapped = a[j][i];
            a[j][i] = a[pivot][i];
            a[pivot][i] = swapped;
        }
        for (int i = j + 1; i < 3; i++) {
            double factor = a[i][j] / a[j][j];
            for (int l = j; l < 4; l++)
                a[i][l] -= factor * a[j][l];
        }
    }
    for (int j = 2; j >= 0; j--) {
        answer[j] = a[j][3];
        for (int i = j + 1; i < 3; i++)
            answer[j] -= a[j][i] * answer[i];
        answer[j] /= a[j][j];
    }
    return 1;
}

typedef struct {
    const double *terms, *weights; /* three and one for each of n blocks */
    double inlier_mm, least_inliers;
    Py_ssize_t n, rounds;
} Plane;

enum { FITTED, TOO_FEW, SINGULAR };

/* Fit a plane to the blocks' change, leaving out what is not on it; `misfit` and `sorted` are for n values each. */
static int fit_plane(const Plane *plane, const double *change, double *misfit, double *sorted, double *answer)
{
    double limit_mm = plane->inlier_mm;
    for (Py_ssize_t i = 0; i < plane->n; i++)
        misfit[i] = fabs(change[i]);
    for (Py_ssize_t round = 0; round < plane->rounds; round++) {
        double a[3][4] = {{0.0}};
        Py_ssize_t inliers = 0, next = 0;
        for (Py_ssize_t i = 0; i < plane->n; i++) {
            if (!(misfit[i] <= limit_mm))
                continue; /* NaN is none */
            const double *term = plane->terms + 3 * i;
            for (int j = 0; j < 3; j++) {
                for (int l = 0; l < 3; l++)
                    a[j][l] += term[j] * plane->weights[i] * term[l];
                a[j][3] += term[j] * plane->weights[i] * change[i];
            }
            inliers++;
        }
        if ((double)inliers < plane->least_inliers * (double)plane->n)
            return TOO_FEW;
        if (inliers == 0 || !solve_three(a, answer))
            return SINGULAR;
        for (Py_ssize_t i = 0; i < plane->n; i++) {
            const double *term = plane->terms + 3 * i;
            int was_inlier = misfit[i] <= limit_mm;
            misfit[i] = fabs(change[i] - (term[0] * answer[0] + term[1] * answer[1] + term[2] * answer[2]));
            if (was_inlier && misfit[i] == misfit[i])
                sorted[next++] = misfit[i];
        }
        if (next == 0)
            return SINGULAR;
        double limit = 3.0 * 1.5 * median_of(sorted, next) + 0.5;
        limit_mm = limit < plane->inlier_mm ? limit : plane->inlier_mm;
    }
    return FITTED;
}

/* The median change of a layer's blocks; NaN where too few of them changed by less than a limit. */
static double layer_change(const double *blocks, const int64_t *places, const double *before, Py_ssize_t n,
                           const Plane *plane, double *inliers)
{
    Py_ssize_t count = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double change = blocks[places[i]] - before[i];
        if (change >= -plane->inlier_mm && change < plane->inlier_mm) /* NaN is none */
            inliers[count++] = change;
    }
    return count && (double)count >= plane->least_inliers * (double)n ? select_kth(inliers, count, count / 2) : (double)NAN;
}

/* How the picked blocks have moved, as a plane, at some points, and how a layer has moved as a whole [mm]. False with too
 * few blocks for the plane, None where the numpy form has to judge. */
PyObject *scene_movement(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 12, "scene_movement"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *blocks = array_of(&arrays, args[0], "blocks_mm", 'd', 1);
    Py_buffer *picked = array_of(&arrays, args[1], "picked", 'q', 1);
    Py_buffer *before = array_of(&arrays, args[2], "picked_mm", 'd', 1);
    Py_buffer *terms = array_of(&arrays, args[3], "terms", 'd', 2);
    Py_buffer *weights = array_of(&arrays, args[4], "weights", 'd', 1);
    Py_buffer *layer = array_of(&arrays, args[5], "layer", 'q', 1);
    Py_buffer *layer_before = array_of(&arrays, args[6], "layer_mm", 'd', 1);
    double inlier_mm = number_of(&arrays, args[7], "inlier_mm");
    double least_inliers = number_of(&arrays, args[8], "least_inliers");
    Py_ssize_t rounds = whole_of(&arrays, args[9], "rounds", 1, 1000);
    Py_buffer *points = array_of(&arrays, args[10], "points_mm", 'd', 2);
    Py_buffer *moved = output_of(&arrays, args[11], "moved_mm", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t n = before->shape[0], of_layer = layer->shape[0];
    require(&arrays, picked->shape[0] == n, "picked_mm must be one a picked block");
    require(&arrays, terms->shape[0] == n && terms->shape[1] == 3, "terms must be three a picked block");
    require(&arrays, weights->shape[0] == n, "weights must be one a picked block");
    require(&arrays, layer_before->shape[0] == of_layer, "layer_mm must be one a block of the layer");
    require(&arrays, points->shape[1] == 3 && moved->shape[0] == points->shape[0] + 1,
            "moved_mm must be one a point, and one of the layer");
    if (!arrays.failed)
        require(&arrays, are_indices(picked, blocks->shape[0]) && are_indices(layer, blocks->shape[0]),
                "picked and layer must be of the blocks");
    size_t scratch = (size_t)(3 * n + of_layer + 1);
    double *change = arrays.failed ? NULL : PyMem_Malloc(scratch * sizeof *change), answer[3];
    if (change == NULL && !arrays.failed) {
        PyErr_NoMemory();
        arrays.failed = 1;
    }
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *block = blocks->buf;
    for (Py_ssize_t i = 0; i < n; i++)
        change[i] = block[((const int64_t *)picked->buf)[i]] - ((const double *)before->buf)[i];
    Plane plane = {.terms = terms->buf, .weights = weights->buf, .inlier_mm = inlier_mm,
                   .least_inliers = least_inliers, .n = n, .rounds = rounds};
    ((double *)moved->buf)[points->shape[0]] =
        layer_change(block, layer->buf, layer_before->buf, of_layer, &plane, change + 3 * n);
    int outcome = fit_plane(&plane, change, change + n, change + 2 * n, answer);
    PyMem_Free(change);
    if (outcome != FITTED)
        return finish(&arrays, outcome == TOO_FEW ? Py_False : Py_None);
    for (Py_ssize_t i = 0; i < points->shape[0]; i++) {
        const double *point = (const double *)points->buf + 3 * i;
        ((double *)moved->buf)[i] = answer[0] + answer[1] * point[0] / 1000.0 + answer[2] * point[1] / 1000.0;
    }
    return finish(&arrays, Py_True);
}
