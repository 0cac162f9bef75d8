/* A frame explained by the motion model; engine/motion/stages/projection.py is the numpy form, step by step the same. */
#include "arguments.h"

#include <math.h>
#include <string.h>

#define LANES 16
#define MOST_MODES 128
#define MOST_WIDTHS 16
#define MOST_CELLS 1024
#define BLOCK_POINTS 64

typedef struct {
    double outlier_mm, inlier_mm, converged_mm, small_step_mm, most_unnoticed, least_seen, least_explained, least_slope,
        clip_mm;
    int reweightings;
} Limits;

typedef struct {
    Py_ssize_t k, modes, points, rows, columns, a, b, widths;
    const float *components, *cosine_rows, *cosine_columns, *by_point, *mean_mm;
    const uint8_t *known;
    const double *stiffness, *log_stiffness, *reach, *known_gram;
    double variance_mm2;
} Basis;

typedef struct {
    float *difference, *inside, *misfit, *ratio, *weighted;
    float *across, *line, *sums; /* cosines along the columns, shape (b, columns); a row; shape (a, columns) */
    uint8_t *usable, *inliers, *positive;
    Py_ssize_t seen;
} Frame;

/* Sums of floats in sixteen lanes, added at the end: the same bits on every processor. */
static double lanes_sum(const float *lanes)
{
    double sum = 0.0;
    for (int lane = 0; lane < LANES; lane++)
        sum += (double)lanes[lane];
    return sum;
}

WIDE_VECTORS
static double dot(const float *a, const float *b, Py_ssize_t n)
{
    float lanes[LANES] = {0.0f};
    Py_ssize_t i = 0;
    for (; i + LANES <= n; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            lanes[lane] += a[i + lane] * b[i + lane];
    for (; i < n; i++)
        lanes[0] += a[i] * b[i];
    return lanes_sum(lanes);
}

WIDE_VECTORS
static double sum_of(const float *a, Py_ssize_t n)
{
    float lanes[LANES] = {0.0f};
    Py_ssize_t i = 0;
    for (; i + LANES <= n; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            lanes[lane] += a[i + lane];
    for (; i < n; i++)
        lanes[0] += a[i];
    return lanes_sum(lanes);
}

/* misfit = (difference - surface of the coefficients) * inside */
WIDE_VECTORS
static void misfit_of(const Basis *basis, const Frame *frame, const double *coefficients)
{
    Py_ssize_t columns = basis->columns;
    for (Py_ssize_t row = 0; row < basis->rows; row++) {
        float *line = frame->line;
        memset(line, 0, (size_t)columns * sizeof *line);
        for (Py_ssize_t j = 0; j < basis->b; j++) {
            float factor = 0.0f;
            for (Py_ssize_t i = 0; i < basis->a; i++)
                factor += basis->cosine_rows[row * basis->a + i] * (float)coefficients[basis->k + i * basis->b + j];
            const float *across = frame->across + j * columns;
            for (Py_ssize_t column = 0; column < columns; column++)
                line[column] += factor * across[column];
        }
        for (Py_ssize_t j = 0; j < basis->k; j++) {
            const float *component = basis->components + j * basis->points + row * columns;
            float factor = (float)coefficients[j];
            for (Py_ssize_t column = 0; column < columns; column++)
                line[column] += factor * component[column];
        }
        const float *difference = frame->difference + row * columns, *inside = frame->inside + row * columns;
        float *misfit = frame->misfit + row * columns;
        for (Py_ssize_t column = 0; column < columns; column++)
            misfit[column] = (difference[column] - line[column]) * inside[column];
    }
}

/* Sum a field at the sampled points over each mode. */
WIDE_VECTORS
static void products_of(const Basis *basis, const Frame *frame, const float *field, double *products)
{
    Py_ssize_t columns = basis->columns;
    for (Py_ssize_t j = 0; j < basis->k; j++)
        products[j] = dot(basis->components + j * basis->points, field, basis->points);
    float *sums = frame->sums; /* over the rows, for each cosine along them and each column */
    memset(sums, 0, (size_t)(basis->a * columns) * sizeof *sums);
    for (Py_ssize_t row = 0; row < basis->rows; row++)
        for (Py_ssize_t i = 0; i < basis->a; i++) {
            const float *line = field + row * columns;
            float factor = basis->cosine_rows[row * basis->a + i], *target = sums + i * columns;
            for (Py_ssize_t column = 0; column < columns; column++)
                target[column] += factor * line[column];
        }
    for (Py_ssize_t i = 0; i < basis->a; i++)
        for (Py_ssize_t j = 0; j < basis->b; j++)
            products[basis->k + i * basis->b + j] = dot(sums + i * columns, frame->across + j * columns, columns);
}

#define GROUP 8

/* Add the products of a point's modes to a block of `width` columns, a multiple of GROUP. */
WIDE_VECTORS
static void add_products(const float *point, Py_ssize_t modes, Py_ssize_t width, float *block)
{
    float padded[MOST_MODES + GROUP] = {0.0f};
    memcpy(padded, point, (size_t)modes * sizeof *point);
    for (Py_ssize_t j = 0; j < modes; j++) {
        float factor = padded[j], *line = block + j * width;
        for (Py_ssize_t l = 0; l < width; l += GROUP)
            for (int lane = 0; lane < GROUP; lane++)
                line[l + lane] += factor * padded[l + lane];
    }
}

/* Add or subtract the products of the modes over the chosen points: the usable ones, or the known ones that are not. */
static void add_gram(const Basis *basis, const uint8_t *known, const uint8_t *usable, double sign, float *block,
                     double *gram)
{
    Py_ssize_t modes = basis->modes, width = (modes + GROUP - 1) / GROUP * GROUP, inside = 0;
    memset(block, 0, (size_t)(modes * width) * sizeof *block);
    for (Py_ssize_t i = 0; i <= basis->points; i++) {
        if ((i == basis->points && inside) || inside == BLOCK_POINTS) {
            for (Py_ssize_t j = 0; j < modes; j++)
                for (Py_ssize_t l = 0; l < modes; l++)
                    gram[j * modes + l] += sign * (double)block[j * width + l];
            memset(block, 0, (size_t)(modes * width) * sizeof *block);
            inside = 0;
        }
        if (i == basis->points || !(known == NULL ? usable[i] : (known[i] && !usable[i])))
            continue;
        add_products(basis->by_point + i * modes, modes, width, block);
        inside++;
    }
}

static void gram_of(const Basis *basis, const uint8_t *usable, float *block, double *gram)
{
    Py_ssize_t missing = 0;
    for (Py_ssize_t i = 0; i < basis->points; i++)
        missing += basis->known[i] && !usable[i];
    if (2 * missing > basis->points) {
        memset(gram, 0, (size_t)(basis->modes * basis->modes) * sizeof *gram);
        add_gram(basis, NULL, usable, 1.0, block, gram);
    } else {
        memcpy(gram, basis->known_gram, (size_t)(basis->modes * basis->modes) * sizeof *gram);
        add_gram(basis, basis->known, usable, -1.0, block, gram);
    }
}

static inline double dot_of(const double *a, const double *b, Py_ssize_t n)
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

/* Solve (gram + stiffness) answer = right by Cholesky's factors, by rows of the upper one; half the logarithm of the
 * determinant beside it. 0 where the matrix is not positive. */
WIDE_VECTORS
static int solve(Py_ssize_t n, const double *gram, const double *stiffness, const double *right, double *factor,
                 double *answer, double *log_determinant)
{
    double product = 1.0;
    *log_determinant = 0.0;
    memcpy(factor, gram, (size_t)(n * n) * sizeof *factor);
    memcpy(answer, right, (size_t)n * sizeof *answer);
    for (Py_ssize_t j = 0; j < n; j++) {
        double *row = factor + j * n, pivot = row[j] + stiffness[j];
        if (!(pivot > 0.0) || !isfinite(pivot))
            return 0;
        row[j] = sqrt(pivot);
        product *= row[j];
        if (!(product > 1e-100 && product < 1e100)) {
            *log_determinant += log(product);
            product = 1.0;
        }
        double inverse = 1.0 / row[j];
        for (Py_ssize_t l = j + 1; l < n; l++)
            row[l] *= inverse;
        answer[j] *= inverse;
        double solved = answer[j];
        for (Py_ssize_t l = j + 1; l < n; l++)
            answer[l] -= row[l] * solved;
        for (Py_ssize_t i = j + 1; i < n; i++) {
            double *target = factor + i * n, share = row[i];
            for (Py_ssize_t l = i; l < n; l++)
                target[l] -= share * row[l];
        }
    }
    *log_determinant += log(product);
    for (Py_ssize_t i = n - 1; i >= 0; i--) {
        const double *row = factor + i * n;
        answer[i] = (answer[i] - dot_of(row + i + 1, answer + i + 1, n - 1 - i)) / row[i];
    }
    return 1;
}

/* Square of a misfit over that of an outlier, up to 1. */
WIDE_VECTORS
static void ratios_of(const Frame *frame, float outlier_mm, Py_ssize_t n)
{
    float scale = (float)(1.0 / ((double)outlier_mm * (double)outlier_mm));
    for (Py_ssize_t i = 0; i < n; i++) {
        float ratio = frame->misfit[i] * frame->misfit[i] * scale;
        ratio = ratio < 1.0f ? ratio : 1.0f;
        frame->ratio[i] = ratio;
        frame->weighted[i] = (1.0f - ratio) * (1.0f - ratio) * frame->inside[i];
    }
}

/* Which points are seen and known, and their difference from the mean; returns their number. */
WIDE_VECTORS
static Py_ssize_t take_points(const Basis *basis, const float *depth_mm, const uint8_t *valid, const Frame *frame)
{
    int32_t seen = 0;
    for (Py_ssize_t i = 0; i < basis->points; i++)
        frame->usable[i] = (uint8_t)((valid[i] != 0) & (basis->known[i] != 0));
    for (Py_ssize_t i = 0; i < basis->points; i++)
        seen += frame->usable[i];
    for (Py_ssize_t i = 0; i < basis->points; i++)
        frame->inside[i] = (float)frame->usable[i];
    for (Py_ssize_t i = 0; i < basis->points; i++) {
        float difference = depth_mm[i] - basis->mean_mm[i];
        frame->difference[i] = frame->inside[i] > 0.0f ? difference : 0.0f;
    }
    return seen;
}

/* Which points have a weight, and how many; returns how many others than before. */
WIDE_VECTORS
static Py_ssize_t take_positive(const Frame *frame, Py_ssize_t n, Py_ssize_t *positives)
{
    int32_t changed = 0, found = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        frame->positive[i] = frame->weighted[i] > 0.0f;
    for (Py_ssize_t i = 0; i < n; i++)
        found += frame->positive[i];
    for (Py_ssize_t i = 0; i < n; i++)
        changed += frame->positive[i] ^ frame->inliers[i];
    *positives = found;
    return changed;
}

/* Which usable points are explained; returns their number. */
WIDE_VECTORS
static Py_ssize_t take_explained(const Frame *frame, Py_ssize_t n, float inlier_mm, uint8_t *is_seen)
{
    int32_t inliers = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        is_seen[i] = fabsf(frame->misfit[i]) < inlier_mm;
    for (Py_ssize_t i = 0; i < n; i++)
        is_seen[i] &= frame->usable[i];
    for (Py_ssize_t i = 0; i < n; i++)
        inliers += is_seen[i];
    return inliers;
}

/* The misfits within a bound. */
WIDE_VECTORS
static void clip_misfit(const Frame *frame, Py_ssize_t n, float clip)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        float misfit = frame->misfit[i] > -clip ? frame->misfit[i] : -clip;
        frame->weighted[i] = misfit < clip ? misfit : clip;
    }
}

/* Share of the valid points that the present misfit explains. */
static double explained_of(const Basis *basis, const Frame *frame, const Limits *limits)
{
    ratios_of(frame, (float)limits->outlier_mm, basis->points);
    return sum_of(frame->weighted, basis->points) / (double)frame->seen;
}

typedef struct {
    double *gram, *right, *factor, *coefficients, *answer, *products, *answers;
    float *block;
    double log_determinant;
} Work;

/* Start from the previous frame, unless a fit to all pixels explains much more; leaves its misfit. */
static int start_from(const Basis *basis, const Frame *frame, const Limits *limits, const double *start, Work *work)
{
    size_t size = (size_t)basis->modes * sizeof(double);
    double before = 0.0;
    if (start != NULL) {
        misfit_of(basis, frame, start);
        before = explained_of(basis, frame, limits);
        if (before >= limits->least_explained) {
            memcpy(work->coefficients, start, size);
            return 1;
        }
    }
    products_of(basis, frame, frame->difference, work->right);
    if (!solve(basis->modes, work->gram, basis->stiffness + (basis->widths - 1) * basis->modes, work->right, work->factor,
               work->coefficients, &work->log_determinant))
        return 0;
    misfit_of(basis, frame, work->coefficients);
    if (start != NULL && before >= explained_of(basis, frame, limits)) {
        memcpy(work->coefficients, start, size);
        misfit_of(basis, frame, start);
    }
    return 1;
}

/* Find the inliers and solve the normal equations over them under the widest prior. */
static int settle(const Basis *basis, const Frame *frame, const Limits *limits, const double *start, Work *work)
{
    Py_ssize_t n = basis->points, modes = basis->modes;
    memcpy(frame->inliers, frame->usable, (size_t)n);
    gram_of(basis, frame->inliers, work->block, work->gram);
    if (!start_from(basis, frame, limits, start, work))
        return 0;
    double limit_mm = limits->small_step_mm;
    for (int round = 0; round < limits->reweightings; round++) {
        ratios_of(frame, (float)limits->outlier_mm, n);
        Py_ssize_t positives = 0, changed = take_positive(frame, n, &positives);
        if ((double)changed > limits->most_unnoticed * (double)n) {
            memcpy(frame->inliers, frame->positive, (size_t)n);
            gram_of(basis, frame->inliers, work->block, work->gram);
            limit_mm = limits->converged_mm;
        }
        double slope = (double)frame->seen - 6.0 * sum_of(frame->ratio, n) + 5.0 * dot(frame->ratio, frame->ratio, n);
        slope /= positives > 1 ? (double)positives : 1.0;
        slope = slope > limits->least_slope ? slope : limits->least_slope;
        for (Py_ssize_t i = 0; i < n; i++)
            frame->weighted[i] *= frame->misfit[i];
        products_of(basis, frame, frame->weighted, work->products);
        for (Py_ssize_t i = 0; i < modes; i++)
            work->right[i] = dot_of(work->gram + i * modes, work->coefficients, modes) + work->products[i] / slope;
        if (!solve(modes, work->gram, basis->stiffness + (basis->widths - 1) * modes, work->right, work->factor,
                   work->answer, &work->log_determinant))
            return 0;
        double largest_mm = 0.0;
        for (Py_ssize_t i = 0; i < modes; i++) {
            double step_mm = fabs(work->answer[i] - work->coefficients[i]) * basis->reach[i];
            if (!(step_mm <= largest_mm))
                largest_mm = isnan(step_mm) ? (double)INFINITY : step_mm; /* which stays */
        }
        if (largest_mm < limit_mm)
            break;
        memcpy(work->coefficients, work->answer, (size_t)modes * sizeof(double));
        limit_mm = limits->converged_mm;
        misfit_of(basis, frame, work->coefficients);
    }
    return 1;
}

/* Average the answers under every width of the cosines' prior, each by its evidence. */
static int weigh_widths(const Basis *basis, Work *work, double *coefficients)
{
    Py_ssize_t modes = basis->modes, last = basis->widths - 1;
    double evidence[MOST_WIDTHS], highest = -INFINITY, total = 0.0;
    for (Py_ssize_t width = 0; width <= last; width++) {
        double *answer = work->answers + width * modes, log_determinant = work->log_determinant, fit = 0.0;
        if (width == last)
            memcpy(answer, work->answer, (size_t)modes * sizeof *answer);
        else if (!solve(modes, work->gram, basis->stiffness + width * modes, work->right, work->factor, answer,
                        &log_determinant))
            return 0;
        for (Py_ssize_t i = 0; i < modes; i++)
            fit += work->right[i] * answer[i];
        evidence[width] = basis->log_stiffness[width] + 0.5 * fit / basis->variance_mm2 - log_determinant;
        highest = evidence[width] > highest ? evidence[width] : highest;
    }
    memset(coefficients, 0, (size_t)modes * sizeof *coefficients);
    for (Py_ssize_t width = 0; width <= last; width++) {
        evidence[width] = exp(evidence[width] - highest);
        total += evidence[width];
    }
    for (Py_ssize_t width = 0; width <= last; width++)
        for (Py_ssize_t i = 0; i < modes; i++)
            coefficients[i] += evidence[width] / total * work->answers[width * modes + i];
    for (Py_ssize_t i = 0; i < modes; i++)
        if (!isfinite(coefficients[i]))
            return 0;
    return 1;
}

/* Largest mean misfit of a cell, NaN where too little of every cell is seen. */
static double largest_cell_misfit(const Basis *basis, const Frame *frame, const Limits *limits, const int64_t *cell_of_row,
                                  const int64_t *cell_of_column, const double *least, Py_ssize_t rows, Py_ssize_t columns)
{
    double sums[MOST_CELLS] = {0.0}, largest = -1.0;
    int counts[MOST_CELLS] = {0};
    clip_misfit(frame, basis->points, (float)limits->clip_mm);
    for (Py_ssize_t row = 0; row < basis->rows; row++)
        for (Py_ssize_t column = 0; column < basis->columns;) {
            Py_ssize_t cell = cell_of_column[column];
            double sum = 0.0;
            int seen = 0;
            for (; column < basis->columns && cell_of_column[column] == cell; column++) {
                Py_ssize_t i = row * basis->columns + column;
                sum += (double)frame->weighted[i];
                seen += frame->usable[i];
            }
            sums[cell_of_row[row] * columns + cell] += sum;
            counts[cell_of_row[row] * columns + cell] += seen;
        }
    for (Py_ssize_t cell = 0; cell < rows * columns; cell++)
        if ((double)counts[cell] >= least[cell] && counts[cell] > 0)
            largest = fmax(largest, fabs(sums[cell]) / (double)counts[cell]);
    return largest < 0.0 ? (double)NAN : largest;
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

#define ARGUMENTS 22

/* Takes what `Basis` holds, then depth and valid of the region, the start or None, the cells' rows and columns and least
 * counts, the limits; fills coefficients, is_seen and figures: seen, inliers, known, residual. False where too little is
 * seen, None where the numpy form has to judge: a matrix that is not positive, or a result that is not finite. */
PyObject *project(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, ARGUMENTS, "project"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *components = array_of(&arrays, args[0], "sampled_components", 'f', 2);
    Py_buffer *cosine_rows = array_of(&arrays, args[1], "cosine_rows", 'f', 2);
    Py_buffer *cosine_columns = array_of(&arrays, args[2], "cosine_columns", 'f', 2);
    Py_buffer *by_point = array_of(&arrays, args[3], "points", 'f', 2);
    Py_buffer *mean_mm = array_of(&arrays, args[4], "sampled_mean_mm", 'f', 1);
    Py_buffer *known = array_of(&arrays, args[5], "sampled_known", '?', 1);
    Py_buffer *stiffness = array_of(&arrays, args[6], "stiffness", 'd', 2);
    Py_buffer *log_stiffness = array_of(&arrays, args[7], "log_stiffness", 'd', 1);
    double variance_mm2 = number_of(&arrays, args[8], "variance_mm2");
    Py_buffer *reach = array_of(&arrays, args[9], "reach", 'd', 1);
    Py_buffer *known_gram = array_of(&arrays, args[10], "known_gram", 'd', 2);
    Py_buffer *depth = array_of(&arrays, args[11], "depth_mm", 'f', 2);
    Py_buffer *valid = array_of(&arrays, args[12], "valid", '?', 2);
    Py_buffer *start = args[13] == Py_None ? NULL : array_of(&arrays, args[13], "start", 'd', 1);
    Py_buffer *cell_of_row = array_of(&arrays, args[14], "cell_of_row", 'q', 1);
    Py_buffer *cell_of_column = array_of(&arrays, args[15], "cell_of_column", 'q', 1);
    Py_buffer *least = array_of(&arrays, args[16], "least_pixels", 'd', 2);
    Py_buffer *constants = array_of(&arrays, args[17], "limits", 'd', 1);
    Py_ssize_t reweightings = whole_of(&arrays, args[18], "reweightings", 1, 1000);
    Py_buffer *coefficients = output_of(&arrays, args[19], "coefficients", 'd', 1);
    Py_buffer *is_seen = output_of(&arrays, args[20], "is_seen", '?', 2);
    Py_buffer *figures = output_of(&arrays, args[21], "figures", 'd', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Basis basis = {
        .k = components->shape[0], .points = components->shape[1], .rows = cosine_rows->shape[0],
        .columns = cosine_columns->shape[0], .a = cosine_rows->shape[1], .b = cosine_columns->shape[1],
        .widths = stiffness->shape[0], .components = components->buf, .cosine_rows = cosine_rows->buf,
        .cosine_columns = cosine_columns->buf, .by_point = by_point->buf, .mean_mm = mean_mm->buf, .known = known->buf,
        .stiffness = stiffness->buf, .log_stiffness = log_stiffness->buf, .reach = reach->buf,
        .known_gram = known_gram->buf, .variance_mm2 = variance_mm2,
    };
    Py_ssize_t n = basis.points, modes = basis.k + basis.a * basis.b;
    basis.modes = modes;
    require(&arrays, n > 0 && n == basis.rows * basis.columns, "the cosines must be of the sampled points");
    require(&arrays, modes > 0 && modes <= MOST_MODES && basis.widths > 0 && basis.widths <= MOST_WIDTHS,
            "too many modes or widths");
    require(&arrays, by_point->shape[0] == n && by_point->shape[1] == modes, "points must be all modes of each point");
    require(&arrays, mean_mm->shape[0] == n && known->shape[0] == n, "mean and known must be of the sampled points");
    require(&arrays, stiffness->shape[1] == modes && log_stiffness->shape[0] == basis.widths && reach->shape[0] == modes,
            "stiffness and reach must be of the modes");
    require(&arrays, known_gram->shape[0] == modes && known_gram->shape[1] == modes, "known_gram must be of the modes");
    require(&arrays, depth->shape[0] == basis.rows && depth->shape[1] == basis.columns, "depth_mm must be sampled");
    require(&arrays, valid->shape[0] == basis.rows && valid->shape[1] == basis.columns, "valid must be sampled");
    require(&arrays, is_seen->shape[0] == basis.rows && is_seen->shape[1] == basis.columns, "is_seen must be sampled");
    require(&arrays, start == NULL || start->shape[0] == modes, "start must be of the modes");
    require(&arrays, coefficients->shape[0] == modes && figures->shape[0] == 4, "coefficients must be of the modes");
    require(&arrays, least->shape[0] <= MOST_CELLS && least->shape[1] <= MOST_CELLS &&
            least->shape[0] * least->shape[1] <= MOST_CELLS, "too many cells");
    require(&arrays, constants->shape[0] == 9, "limits must be nine");
    if (!arrays.failed)
        require(&arrays, are_cells(cell_of_row, basis.rows, least->shape[0]) &&
                are_cells(cell_of_column, basis.columns, least->shape[1]), "every row and column must be of a cell");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *c = constants->buf;
    Limits limits = {
        .outlier_mm = c[0], .inlier_mm = c[1], .converged_mm = c[2], .small_step_mm = c[3], .most_unnoticed = c[4],
        .least_seen = c[5], .least_explained = c[6], .least_slope = c[7], .clip_mm = c[8],
        .reweightings = (int)reweightings,
    };
    size_t doubles = (size_t)(2 * modes * modes + (4 + basis.widths) * modes);
    size_t floats = (size_t)(5 * n + (basis.a + basis.b + 1) * basis.columns + modes * (modes + GROUP));
    char *memory = PyMem_Malloc(doubles * sizeof(double) + floats * sizeof(float) + (size_t)(3 * n));
    if (memory == NULL) {
        PyErr_NoMemory();
        arrays.failed = 1;
        return finish(&arrays, Py_None);
    }
    double *d = (double *)memory;
    Work work = {
        .gram = d, .factor = d + modes * modes, .right = d + 2 * modes * modes,
        .coefficients = d + 2 * modes * modes + modes, .answer = d + 2 * modes * modes + 2 * modes,
        .products = d + 2 * modes * modes + 3 * modes, .answers = d + 2 * modes * modes + 4 * modes,
    };
    float *f = (float *)(d + doubles);
    uint8_t *u = (uint8_t *)(f + floats);
    Frame frame = {
        .difference = f, .inside = f + n, .misfit = f + 2 * n, .ratio = f + 3 * n, .weighted = f + 4 * n,
        .across = f + 5 * n, .line = f + 5 * n + basis.b * basis.columns,
        .sums = f + 5 * n + (basis.b + 1) * basis.columns, .usable = u, .inliers = u + n, .positive = u + 2 * n,
    };
    work.block = f + 5 * n + (basis.a + basis.b + 1) * basis.columns;
    Py_ssize_t known_points = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        known_points += basis.known[i] != 0;
    frame.seen = take_points(&basis, depth->buf, valid->buf, &frame);
    for (Py_ssize_t j = 0; j < basis.b; j++)
        for (Py_ssize_t column = 0; column < basis.columns; column++)
            frame.across[j * basis.columns + column] = basis.cosine_columns[column * basis.b + j];
    PyObject *outcome = Py_True;
    if ((double)frame.seen < limits.least_seen * (double)n) {
        outcome = Py_False;
    } else if (!settle(&basis, &frame, &limits, start == NULL ? NULL : start->buf, &work) ||
               !weigh_widths(&basis, &work, coefficients->buf)) {
        outcome = Py_None;
    } else {
        misfit_of(&basis, &frame, coefficients->buf);
        Py_ssize_t inliers = take_explained(&frame, n, (float)limits.inlier_mm, is_seen->buf);
        double *figure = figures->buf;
        figure[0] = (double)frame.seen;
        figure[1] = (double)inliers;
        figure[2] = (double)known_points;
        figure[3] = largest_cell_misfit(&basis, &frame, &limits, cell_of_row->buf, cell_of_column->buf, least->buf,
                                        least->shape[0], least->shape[1]);
    }
    PyMem_Free(memory);
    return finish(&arrays, outcome);
}
