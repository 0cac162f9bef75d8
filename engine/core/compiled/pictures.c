/* What is read from the colour and the depth picture: stickers, colour, the region's grid. */
#include "arguments.h"

#include <math.h>
#include <string.h>

static uint8_t whiteness(const uint8_t *pixel)
{
    uint8_t least = pixel[0] < pixel[1] ? pixel[0] : pixel[1];
    return least < pixel[2] ? least : pixel[2];
}

typedef struct {
    const uint8_t *color;
    Py_ssize_t rows, columns, reach;
    const int64_t *ring, *disc;
    Py_ssize_t ring_size, disc_size;
    const float *within; /* first of the six moments: 1 up to the ring, 0 beyond */
    float min_contrast, max_background_share;
    double max_bright;
} Stencil;

/* The upper median of some pixels of a patch. */
static int upper_median(const uint8_t *patch, const int64_t *at, Py_ssize_t size)
{
    int counts[256] = {0};
    for (Py_ssize_t i = 0; i < size; i++)
        counts[patch[at[i]]]++;
    Py_ssize_t below = 0;
    for (int value = 0; value < 256; value++) {
        below += counts[value];
        if (below > size / 2)
            return value;
    }
    return 255;
}

/* Total, mean x and y, and central second moments of the sticker in a patch; 0 where there is none. */
static int moments_of(const Stencil *stencil, const uint8_t *patch, double *sums)
{
    Py_ssize_t side = 2 * stencil->reach + 1;
    float background = (float)upper_median(patch, stencil->ring, stencil->ring_size);
    float foreground = (float)upper_median(patch, stencil->disc, stencil->disc_size);
    float contrast = foreground - background, middle = 0.5f * (background + foreground);
    Py_ssize_t bright = 0;
    for (Py_ssize_t i = 0; i < stencil->ring_size; i++)
        bright += (float)patch[stencil->ring[i]] > middle;
    if (!(contrast >= stencil->min_contrast) || !(background <= stencil->max_background_share * foreground) ||
        !((double)bright <= stencil->max_bright))
        return 0;
    float gain = 2.0f / (contrast > 1.0f ? contrast : 1.0f), offset = background * gain + 0.5f;
    memset(sums, 0, 6 * sizeof *sums);
    for (Py_ssize_t row = 0; row < side; row++) {
        const uint8_t *line = patch + row * side;
        const float *within = stencil->within + row * side * 6;
        double y = (double)(row - stencil->reach), s0 = 0.0, s1 = 0.0, s2 = 0.0;
        for (Py_ssize_t column = 0; column < side; column++) {
            float weight = (float)line[column] * gain - offset;
            weight = weight < 0.0f ? 0.0f : weight;
            weight = weight > 1.0f ? 1.0f : weight;
            double w = (double)(weight * within[column * 6]), x = (double)(column - stencil->reach);
            s0 += w;
            s1 += w * x;
            s2 += w * x * x;
        }
        sums[0] += s0;
        sums[1] += s1;
        sums[2] += y * s0;
        sums[3] += s2;
        sums[4] += y * s1;
        sums[5] += y * y * s0;
    }
    if (!(sums[0] > 0.0))
        return 0;
    double total = sums[0] > 1e-9 ? sums[0] : 1e-9;
    for (int i = 1; i < 6; i++)
        sums[i] /= total;
    sums[3] -= sums[1] * sums[1];
    sums[4] -= sums[1] * sums[2];
    sums[5] -= sums[2] * sums[2];
    return 1;
}

/* Iterate to the sticker near a start; 1 and the moments and the centre where one was found. */
static int refine(const Stencil *stencil, const double *start, int steps, double converged_px, uint8_t *patch,
                  double *found)
{
    double x = rint(start[0]), y = rint(start[1]), reach = (double)stencil->reach;
    Py_ssize_t side = 2 * stencil->reach + 1;
    for (int step = 0; step < steps; step++) {
        if (!(x >= reach && y >= reach && x < (double)(stencil->columns - stencil->reach) &&
              y < (double)(stencil->rows - stencil->reach)))
            return 0;
        Py_ssize_t left = (Py_ssize_t)x - stencil->reach, top = (Py_ssize_t)y - stencil->reach;
        for (Py_ssize_t row = 0; row < side; row++) {
            const uint8_t *line = stencil->color + ((top + row) * stencil->columns + left) * 3;
            for (Py_ssize_t column = 0; column < side; column++)
                patch[row * side + column] = whiteness(line + 3 * column);
        }
        if (!moments_of(stencil, patch, found))
            return 0;
        found[6] = x + found[1];
        found[7] = y + found[2];
        if (fmax(fabs(found[1]), fabs(found[2])) <= converged_px)
            return 1;
        x = rint(found[6]);
        y = rint(found[7]);
    }
    return 0;
}

typedef struct {
    double diameter_px, tolerance, min_aspect, min_fill, max_fill;
} Disc;

/* Whether moments are those of a disc of about this diameter, seen on a slope; `_is_disc` is the numpy form. */
static int is_disc(const double *found, const Disc *disc)
{
    double mean = 0.5 * (found[3] + found[5]), half_spread = hypot(0.5 * (found[3] - found[5]), found[4]);
    double minor = 4.0 * sqrt(fmax(mean - half_spread, 1e-9)), major = 4.0 * sqrt(fmax(mean + half_spread, 1e-9));
    double ratio = major / disc->diameter_px, fill = found[0] / (0.25 * 3.141592653589793 * minor * major);
    return ratio >= 1.0 / disc->tolerance && ratio <= disc->tolerance && !(minor / major < disc->min_aspect) &&
           fill >= disc->min_fill && fill <= disc->max_fill;
}

PyObject *refine_markers(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 18, "refine_markers"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *color = array_of(&arrays, args[0], "color", 'B', 3);
    Py_buffer *starts = array_of(&arrays, args[1], "starts", 'd', 2);
    Py_ssize_t reach = whole_of(&arrays, args[2], "reach", 0, 4096);
    Py_buffer *ring = array_of(&arrays, args[3], "ring", 'q', 1);
    Py_buffer *disc = array_of(&arrays, args[4], "disc", 'q', 1);
    Py_buffer *moments = array_of(&arrays, args[5], "moments", 'f', 2);
    double min_contrast = number_of(&arrays, args[6], "min_contrast");
    double max_background_share = number_of(&arrays, args[7], "max_background_share");
    double max_bright = number_of(&arrays, args[8], "max_bright");
    Py_ssize_t steps = whole_of(&arrays, args[9], "steps", 0, 1000);
    double converged_px = number_of(&arrays, args[10], "converged_px");
    Disc shape = {
        .diameter_px = number_of(&arrays, args[11], "diameter_px"),
        .tolerance = number_of(&arrays, args[12], "diameter_tolerance"),
        .min_aspect = number_of(&arrays, args[13], "min_aspect"),
        .min_fill = number_of(&arrays, args[14], "min_fill"),
        .max_fill = number_of(&arrays, args[15], "max_fill"),
    };
    Py_buffer *found = output_of(&arrays, args[16], "found", 'd', 2);
    Py_buffer *is_found = output_of(&arrays, args[17], "is_found", '?', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t side = 2 * reach + 1;
    require(&arrays, color->shape[2] == 3, "color must have three channels");
    require(&arrays, starts->shape[1] == 2, "starts must be pairs");
    require(&arrays, moments->shape[0] == side * side && moments->shape[1] == 6, "moments must be of the patch");
    require(&arrays, ring->shape[0] > 0 && disc->shape[0] > 0, "ring and disc must have pixels");
    require(&arrays, found->shape[0] == starts->shape[0] && found->shape[1] == 8, "found must be eight for each start");
    require(&arrays, is_found->shape[0] == starts->shape[0], "is_found must be one for each start");
    if (!arrays.failed)
        require(&arrays, are_indices(ring, side * side) && are_indices(disc, side * side), "an index is off the patch");
    uint8_t *patch = arrays.failed ? NULL : PyMem_Malloc((size_t)(side * side));
    if (patch == NULL) {
        if (!arrays.failed)
            PyErr_NoMemory();
        arrays.failed = 1;
        return finish(&arrays, Py_None);
    }
    Stencil stencil = {
        .color = color->buf, .rows = color->shape[0], .columns = color->shape[1], .reach = reach,
        .ring = ring->buf, .disc = disc->buf, .ring_size = ring->shape[0], .disc_size = disc->shape[0],
        .within = moments->buf, .min_contrast = (float)min_contrast,
        .max_background_share = (float)max_background_share, .max_bright = max_bright,
    };
    for (Py_ssize_t i = 0; i < starts->shape[0]; i++) {
        double *moment = (double *)found->buf + 8 * i;
        int is_sticker = refine(&stencil, (const double *)starts->buf + 2 * i, (int)steps, converged_px, patch, moment);
        ((uint8_t *)is_found->buf)[i] = (uint8_t)(is_sticker && is_disc(moment, &shape));
    }
    PyMem_Free(patch);
    return finish(&arrays, Py_None);
}

/* Red and green as shares of brightness; NaN where it is dark. */
static void shares_of(const uint8_t *pixel, float least_brightness, float *shares)
{
    float red = (float)pixel[0], green = (float)pixel[1], brightness = red + green + (float)pixel[2];
    float divisor = brightness > 1.0f ? brightness : 1.0f;
    shares[0] = brightness >= least_brightness ? red / divisor : NAN;
    shares[1] = brightness >= least_brightness ? green / divisor : NAN;
}

#define SAMPLES 4 /* along each side of a cell */
#define MOST_SAMPLES 1024 /* in a row of cells */
#define NEAREST 6755399441055744.0 /* added and subtracted again: the nearest integer, the even one of two */

/* The pixel of each sample in a row, as its number in the picture; -1 outside of the picture and where it is no number. */
WIDE_VECTORS
static void sampled_row(const double *h, double y, int samples, int32_t rows, int32_t columns, int32_t *at)
{
    double at_u = h[1] * y + h[2], at_v = h[4] * y + h[5], at_w = h[7] * y + h[8], u[MOST_SAMPLES], v[MOST_SAMPLES];
    double right = (double)columns, bottom = (double)rows;
    for (int x = 0; x < samples; x++) {
        double w = 1.0 / (h[6] * (double)x + at_w);
        u[x] = ((h[0] * (double)x + at_u) * w + NEAREST) - NEAREST;
        v[x] = ((h[3] * (double)x + at_v) * w + NEAREST) - NEAREST;
        u[x] = u[x] >= 0.0 && u[x] < right ? u[x] : -1.0;
        v[x] = v[x] >= 0.0 && v[x] < bottom ? v[x] : -1.0;
    }
    for (int x = 0; x < samples; x++) {
        int32_t column = (int32_t)u[x], row = (int32_t)v[x];
        at[x] = column < 0 || row < 0 ? -1 : row * columns + column;
    }
}

/* Whether all samples are in the picture and before its last pixel: four bytes may be read at each of them. */
WIDE_VECTORS
static int are_inside(const int32_t *at, int samples, int32_t last)
{
    int32_t lowest = 0, highest = 0;
    for (int x = 0; x < samples; x++) {
        lowest = at[x] < lowest ? at[x] : lowest;
        highest = at[x] > highest ? at[x] : highest;
    }
    return lowest >= 0 && highest < last;
}

/* A pixel as red, green, blue and, above them, what follows it. */
static inline uint32_t with_next(const uint8_t *pixel)
{
    return pixel[0] | (uint32_t)pixel[1] << 8 | (uint32_t)pixel[2] << 16 | (uint32_t)pixel[3] << 24;
}

/* The same where nothing may follow, or the pixel is not in the picture. */
static inline uint32_t alone(const uint8_t *pixel)
{
    return pixel[0] | (uint32_t)pixel[1] << 8 | (uint32_t)pixel[2] << 16;
}

#define AHEAD 4 /* every fourth sample lies in another line of the cache, at most */

/* Where the samples of a row of cells lie; the picture is cold, so that they are fetched ahead. */
static void place_samples(const uint8_t *pixels, Py_ssize_t rows, Py_ssize_t columns, const double *h,
                          Py_ssize_t cell_row, int samples, int32_t at[SAMPLES][MOST_SAMPLES])
{
    for (Py_ssize_t line = 0; line < SAMPLES; line++) {
        double y = (double)(cell_row * SAMPLES + line);
        sampled_row(h, y, samples, (int32_t)rows, (int32_t)columns, at[line]);
        for (int x = 0; x < samples; x += AHEAD)
            if (at[line][x] >= 0)
                __builtin_prefetch(pixels + (Py_ssize_t)at[line][x] * 3);
    }
}

/* Mean colour of each cell in a row of cells; black where it is outside of the picture. Red and blue are summed in one
 * number: sixteen of either stay below 2^16. */
static void mean_colors(const uint8_t *pixels, int32_t last, int32_t at[SAMPLES][MOST_SAMPLES], Py_ssize_t cells,
                        uint8_t *means)
{
    static const uint8_t black[3] = {0, 0, 0};
    uint32_t red_and_blue[MOST_SAMPLES / SAMPLES] = {0}, green[MOST_SAMPLES / SAMPLES] = {0};
    for (Py_ssize_t line = 0; line < SAMPLES; line++) {
        const int32_t *samples = at[line];
        int is_inside = are_inside(samples, (int)cells * SAMPLES, last);
        for (Py_ssize_t cell = 0; cell < cells; cell++, samples += SAMPLES) {
            uint32_t colors[SAMPLES];
            if (is_inside)
                for (int x = 0; x < SAMPLES; x++)
                    colors[x] = with_next(pixels + (Py_ssize_t)samples[x] * 3);
            else
                for (int x = 0; x < SAMPLES; x++)
                    colors[x] = alone(samples[x] < 0 ? black : pixels + (Py_ssize_t)samples[x] * 3);
            for (int x = 0; x < SAMPLES; x++) {
                red_and_blue[cell] += colors[x] & 0x00FF00FFu;
                green[cell] += colors[x] >> 8 & 0xFFu;
            }
        }
    }
    for (Py_ssize_t cell = 0; cell < cells; cell++) {
        uint32_t sums[3] = {red_and_blue[cell] & 0xFFFFu, green[cell], red_and_blue[cell] >> 16};
        for (int i = 0; i < 3; i++)
            means[3 * cell + i] = (uint8_t)(((double)sums[i] / (SAMPLES * SAMPLES) + NEAREST) - NEAREST);
    }
}

#define BINS 512

/* The median of n shares, from 0 to 1, n > 0: only those of its bin are compared. */
static float median_share(const double *shares, Py_ssize_t n, double *chosen)
{
    int counts[2][BINS] = {{0}}; /* of every second share: neighbours are of one bin, and would wait for each other */
    for (Py_ssize_t i = 0; i < n; i++)
        counts[i % 2][(int)(shares[i] * (BINS - 1))]++;
    int bin = 0;
    Py_ssize_t k = n / 2, found = 0;
    for (; k >= counts[0][bin] + counts[1][bin]; bin++)
        k -= counts[0][bin] + counts[1][bin];
    double lower = -1.0; /* the largest of the bins before */
    for (Py_ssize_t i = 0; i < n; i++) {
        int of = (int)(shares[i] * (BINS - 1));
        if (of == bin)
            chosen[found++] = shares[i];
        else if (of < bin)
            lower = shares[i] > lower ? shares[i] : lower;
    }
    double upper = select_kth(chosen, found, k);
    if (n % 2)
        return (float)upper;
    for (Py_ssize_t below = 0; below < k; below++) /* all before the k-th are no larger than it */
        lower = below == 0 || chosen[below] > lower ? chosen[below] : lower;
    return ((float)lower + (float)upper) / 2.0f;
}

PyObject *sample_chroma(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 6, "sample_chroma"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *color = array_of(&arrays, args[0], "color", 'B', 3);
    Py_buffer *homography = array_of(&arrays, args[1], "homography", 'd', 2);
    Py_ssize_t cell_columns = whole_of(&arrays, args[2], "cell_columns", 1, MOST_SAMPLES / SAMPLES);
    Py_buffer *thin = array_of(&arrays, args[3], "thin", 'B', 3);
    double least_brightness = number_of(&arrays, args[4], "least_brightness");
    Py_buffer *chroma = output_of(&arrays, args[5], "chroma", 'f', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    require(&arrays, color->shape[2] == 3 && thin->shape[2] == 3, "color and thin must have three channels");
    require(&arrays, homography->shape[0] == 3 && homography->shape[1] == 3, "homography must be 3 by 3");
    require(&arrays, chroma->shape[1] == 2 && chroma->shape[0] % cell_columns == 0, "chroma must be pairs of whole rows");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = color->shape[0], columns = color->shape[1];
    Py_ssize_t most = thin->shape[0] * thin->shape[1];
    require(&arrays, rows < 32768 && columns < 32768, "color must have less than 32768 rows and columns");
    double *seen = arrays.failed ? NULL : PyMem_Malloc((size_t)(3 * most + 1) * sizeof *seen), *chosen = NULL;
    if (seen == NULL && arrays.failed)
        return finish(&arrays, Py_None);
    if (seen == NULL) {
        PyErr_NoMemory();
        arrays.failed = 1;
        return finish(&arrays, Py_None);
    }
    chosen = seen + 2 * most;
    const uint8_t *pixels = color->buf;
    const double *h = homography->buf;
    float least = (float)least_brightness, balance[2] = {0.0f, 0.0f}, shares[2];
    Py_ssize_t n = 0;
    for (Py_ssize_t i = 0; i < most; i++) {
        shares_of((const uint8_t *)thin->buf + 3 * i, least, shares);
        if (shares[0] == shares[0]) {
            seen[n] = (double)shares[0];
            seen[most + n++] = (double)shares[1];
        }
    }
    if (n > 0)
        for (int i = 0; i < 2; i++)
            balance[i] = median_share(seen + i * most, n, chosen);
    PyMem_Free(seen);
    int32_t at[2][SAMPLES][MOST_SAMPLES];
    Py_ssize_t cell_rows = chroma->shape[0] / cell_columns;
    int samples = (int)cell_columns * SAMPLES;
    if (cell_rows > 0)
        place_samples(pixels, rows, columns, h, 0, samples, at[0]);
    for (Py_ssize_t row = 0; row < cell_rows; row++) {
        uint8_t means[3 * MOST_SAMPLES / SAMPLES];
        float *line = (float *)chroma->buf + 2 * row * cell_columns;
        if (row + 1 < cell_rows)
            place_samples(pixels, rows, columns, h, row + 1, samples, at[(row + 1) % 2]);
        mean_colors(pixels, (int32_t)(rows * columns - 1), at[row % 2], cell_columns, means);
        for (Py_ssize_t cell = 0; cell < cell_columns; cell++) {
            shares_of(means + 3 * cell, least, shares);
            line[2 * cell] = shares[0] - balance[0];
            line[2 * cell + 1] = shares[1] - balance[1];
        }
    }
    return finish(&arrays, Py_None);
}

#define NODE_COLUMNS 9
#define NODE_ROWS 15
#define NODE_STEP 25
#define READINGS 65536

typedef struct {
    const uint16_t *depth;  /* first pixel of the window */
    Py_ssize_t pitch, rows, columns;
    const float *table;
} Window;

/* Split places in the window into their upper left pixel and the shares of the pixels to the right and below; -1 where not
 * all four pixels are in the window. Every place is overwritten by its shares. */
static void pixels_of(const Window *window, float *restrict x, float *restrict y, Py_ssize_t n, int32_t *restrict at)
{
    float right = (float)(window->columns - 1), bottom = (float)(window->rows - 1);
    int32_t pitch = (int32_t)window->pitch;
    for (Py_ssize_t i = 0; i < n; i++) {
        float u = x[i], v = y[i];
        u = (u >= 0.0f) & (u < right) ? u : -1.0f; /* NaN too */
        v = (v >= 0.0f) & (v < bottom) ? v : -1.0f;
        int32_t left = (int32_t)u, top = (int32_t)v;
        at[i] = (left | top) < 0 ? -1 : top * pitch + left;
        x[i] = u - (float)left;
        y[i] = v - (float)top;
    }
}

/* Interpolate where all four pixels around a point have a reading; the number of points that have. */
static Py_ssize_t interpolate_complete(const Window *window, const float *across, const float *along, const int32_t *at,
                                       Py_ssize_t n, float *depth, uint8_t *valid)
{
    Py_ssize_t complete = 0;
    const float *table = window->table;
    for (Py_ssize_t i = 0; i < n; i++) {
        depth[i] = 0.0f;
        valid[i] = 0;
        if (at[i] < 0)
            continue;
        const uint16_t *pixel = window->depth + at[i], *below = pixel + window->pitch;
        float a = table[pixel[0]], b = table[pixel[1]], c = table[below[0]], d = table[below[1]];
        float upper = a + across[i] * (b - a), lower = c + across[i] * (d - c);
        float sum = upper + along[i] * (lower - upper);
        int is_complete = sum > 0.0f; /* not NaN, which a hole makes */
        depth[i] = is_complete ? sum : 0.0f;
        valid[i] = (uint8_t)is_complete;
        complete += is_complete;
    }
    return complete;
}

static float reading_at(const Window *window, Py_ssize_t row, Py_ssize_t column, float *weight)
{
    *weight = 0.0f;
    if (row < 0 || column < 0 || row >= window->rows || column >= window->columns)
        return 0.0f;
    float reading = window->table[window->depth[row * window->pitch + column]];
    if (!(reading > 0.0f))
        return 0.0f;
    *weight = 1.0f;
    return reading;
}

/* Interpolate where readings carry at least a least weight. */
static void interpolate_partial(const Window *window, const float *x, const float *y, Py_ssize_t n, float least,
                                float *depth, uint8_t *valid)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        float column = floorf(x[i]), row = floorf(y[i]), w[4], across = x[i] - column, along = y[i] - row;
        depth[i] = 0.0f;
        valid[i] = 0;
        if (!(column >= -1.0f && row >= -1.0f && column < (float)window->columns && row < (float)window->rows))
            continue;
        Py_ssize_t r = (Py_ssize_t)row, c = (Py_ssize_t)column;
        float a = reading_at(window, r, c, &w[0]), b = reading_at(window, r, c + 1, &w[1]);
        float e = reading_at(window, r + 1, c, &w[2]), d = reading_at(window, r + 1, c + 1, &w[3]);
        float upper = a + across * (b - a), lower = e + across * (d - e);
        float sum = upper + along * (lower - upper);
        upper = w[0] + across * (w[1] - w[0]);
        lower = w[2] + across * (w[3] - w[2]);
        float weight = upper + along * (lower - upper);
        if (weight >= least) {
            depth[i] = sum / weight;
            valid[i] = 1;
        }
    }
}

#define MOST_COLUMNS (NODE_COLUMNS * NODE_STEP)

typedef struct {
    const double *nodes;
    Py_ssize_t columns, stride;
    double left, top;              /* of the window */
    double across[MOST_COLUMNS]; /* share of the way from the node before */
} Grid;

/* The places of a row of the grid's points in the window, bilinear between the nodes. */
WIDE_VECTORS
static void places(const Grid *grid, Py_ssize_t row, float *x, float *y)
{
    Py_ssize_t stride = grid->stride, upper = row * stride / NODE_STEP;
    double along = (double)(row * stride % NODE_STEP) / NODE_STEP;
    const double *above = grid->nodes + 2 * upper * NODE_COLUMNS, *below = above + 2 * NODE_COLUMNS;
    double line[2 * NODE_COLUMNS];
    for (int i = 0; i < NODE_COLUMNS; i++) {
        line[i] = (1.0 - along) * (above[2 * i] - grid->left) + along * (below[2 * i] - grid->left);
        line[NODE_COLUMNS + i] = (1.0 - along) * (above[2 * i + 1] - grid->top) + along * (below[2 * i + 1] - grid->top);
    }
    for (Py_ssize_t node = 0, column = 0; node < NODE_COLUMNS - 1; node++) {
        Py_ssize_t end = ((node + 1) * NODE_STEP + stride - 1) / stride;
        end = end < grid->columns ? end : grid->columns;
        const double *at = line + node;
        for (; column < end; column++) {
            double across = grid->across[column];
            x[column] = (float)((1.0 - across) * at[0] + across * at[1]);
            y[column] = (float)((1.0 - across) * at[NODE_COLUMNS] + across * at[NODE_COLUMNS + 1]);
        }
    }
}

/* Interpolate where all four pixels around a point have a reading; the number of points that have. Row by row: what is in
 * between stays in the nearest cache. */
static Py_ssize_t fill_complete(const Window *window, const Grid *grid, Py_ssize_t rows, float *depth, uint8_t *valid)
{
    Py_ssize_t columns = grid->columns, complete = 0;
    float x[MOST_COLUMNS], y[MOST_COLUMNS];
    int32_t at[MOST_COLUMNS];
    for (Py_ssize_t row = 0; row < rows; row++) {
        places(grid, row, x, y);
        pixels_of(window, x, y, columns, at);
        complete += interpolate_complete(window, x, y, at, columns, depth + row * columns, valid + row * columns);
    }
    return complete;
}

/* Interpolate where readings carry at least a least weight. */
static void fill_partial(const Window *window, const Grid *grid, Py_ssize_t rows, float least, float *depth, uint8_t *valid)
{
    Py_ssize_t columns = grid->columns;
    float x[MOST_COLUMNS], y[MOST_COLUMNS];
    for (Py_ssize_t row = 0; row < rows; row++) {
        places(grid, row, x, y);
        interpolate_partial(window, x, y, columns, least, depth + row * columns, valid + row * columns);
    }
}

/* The window's first and last but one pixel along one side of the picture, as the numpy form cuts it. */
static void reach_of(double low, double high, Py_ssize_t size, Py_ssize_t *first, Py_ssize_t *last)
{
    double from = trunc(low) - 1.0, to = trunc(high) + 3.0;
    *first = (Py_ssize_t)(from < 0.0 ? 0.0 : from > (double)size ? (double)size : from);
    *last = (Py_ssize_t)(to < 0.0 ? 0.0 : to > (double)size ? (double)size : to);
}

PyObject *cut_out(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 8, "cut_out"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *picture = array_of(&arrays, args[0], "depth_mm", 'H', 2);
    Py_buffer *nodes = array_of(&arrays, args[1], "nodes_px", 'd', 2);
    Py_buffer *table = array_of(&arrays, args[2], "table_mm", 'f', 1);
    Py_ssize_t stride = whole_of(&arrays, args[3], "stride_px", 1, 350);
    double least_weight = number_of(&arrays, args[4], "least_weight");
    double least_share = number_of(&arrays, args[5], "least_share");
    Py_buffer *depth = output_of(&arrays, args[6], "depth", 'f', 2);
    Py_buffer *valid = output_of(&arrays, args[7], "valid", '?', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = depth->shape[0], columns = depth->shape[1], n = rows * columns;
    require(&arrays, nodes->shape[0] == NODE_ROWS * NODE_COLUMNS && nodes->shape[1] == 2, "nodes_px must be 135 pairs");
    require(&arrays, table->shape[0] == READINGS, "table_mm must have an entry for every reading");
    require(&arrays, rows <= ((NODE_ROWS - 1) * NODE_STEP - 1) / stride + 1 &&
            columns <= ((NODE_COLUMNS - 1) * NODE_STEP - 1) / stride + 1, "the grid must lie between the nodes");
    require(&arrays, valid->shape[0] == rows && valid->shape[1] == columns, "valid must be as large as depth");
    require(&arrays, least_weight > 0.0, "least_weight must be positive");
    require(&arrays, picture->shape[0] < 32768 && picture->shape[1] < 32768, "depth_mm must have less than 32768 rows");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    const double *node = nodes->buf;
    double low[2] = {node[0], node[1]}, high[2] = {node[0], node[1]};
    int is_finite = 1;
    for (Py_ssize_t i = 0; i < 2 * nodes->shape[0]; i++) {
        is_finite &= isfinite(node[i]) != 0;
        low[i % 2] = node[i] < low[i % 2] ? node[i] : low[i % 2];
        high[i % 2] = node[i] > high[i % 2] ? node[i] : high[i % 2];
    }
    Py_ssize_t left = 0, right = 0, top = 0, bottom = 0;
    if (is_finite) { /* else a node is outside of the depth camera's view or behind it */
        reach_of(low[0], high[0], picture->shape[1], &left, &right);
        reach_of(low[1], high[1], picture->shape[0], &top, &bottom);
    }
    if (right - left < 2 || bottom - top < 2) {
        memset(depth->buf, 0, (size_t)depth->len);
        memset(valid->buf, 0, (size_t)valid->len);
    } else {
        Window window = {
            .depth = (const uint16_t *)picture->buf + top * picture->shape[1] + left, .pitch = picture->shape[1],
            .rows = bottom - top, .columns = right - left, .table = table->buf,
        };
        Grid grid = {.nodes = node, .columns = columns, .stride = stride, .left = (double)left, .top = (double)top};
        for (Py_ssize_t column = 0; column < columns; column++)
            grid.across[column] = (double)(column * stride % NODE_STEP) / NODE_STEP;
        Py_ssize_t complete = fill_complete(&window, &grid, rows, depth->buf, valid->buf);
        if ((double)complete < least_share * (double)n)
            fill_partial(&window, &grid, rows, (float)least_weight, depth->buf, valid->buf);
    }
    return finish(&arrays, Py_None);
}

#define STRIDE 64 /* readings between two looks at how many differ */

/* Whether some earlier picture differs from the readings, where these are any, in `most` of them or fewer. */
WIDE_VECTORS
static int some_differs_little(const uint16_t *earlier, Py_ssize_t pictures, const uint16_t *readings, Py_ssize_t n,
                               Py_ssize_t most)
{
    for (Py_ssize_t i = 0; i < pictures; i++, earlier += n) {
        Py_ssize_t different = 0;
        for (Py_ssize_t first = 0; first < n && different <= most; first += STRIDE) {
            Py_ssize_t end = first + STRIDE < n ? first + STRIDE : n;
            uint16_t part = 0;
            for (Py_ssize_t at = first; at < end; at++)
                part = (uint16_t)(part + ((earlier[at] != readings[at]) & (readings[at] != 0)));
            different += part;
        }
        if (different <= most)
            return 1;
    }
    return 0;
}

#define MOST_TILES 64

enum { READ = 1, SAME = 2, LAST = 4, NEARLY = 8, PART = 16 };

/* Whether a view equals any of the earlier ones, and whether it equals the newest of them. */
static int equal_views(const uint8_t *earlier, Py_ssize_t pictures, Py_ssize_t size, Py_ssize_t newest, const uint8_t *view)
{
    int found = 0;
    for (Py_ssize_t i = 0; i < pictures; i++)
        if (memcmp(earlier + i * size, view, (size_t)size) == 0)
            found |= i == newest ? SAME | LAST : SAME;
    return found;
}

static Py_ssize_t steps_in(Py_ssize_t size, Py_ssize_t step)
{
    return (size + step - 1) / step;
}

/* Every step-th of some values; of every fourth, eight bytes are read at once. */
WIDE_VECTORS
static void thin_line(const uint16_t *line, Py_ssize_t columns, Py_ssize_t step, uint16_t *target)
{
    Py_ssize_t at = 0, fours = step == 4 && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__ ? columns / 4 : 0;
    for (; at < fours; at++) {
        uint64_t four;
        memcpy(&four, line + 4 * at, sizeof four);
        target[at] = (uint16_t)four;
    }
    for (; at * step < columns; at++)
        target[at] = line[at * step];
}

/* Every step-th row and column of a depth picture. */
static void thinned(const Py_buffer *depth, Py_ssize_t step, uint16_t *target)
{
    for (Py_ssize_t row = 0; row < depth->shape[0]; row += step, target += steps_in(depth->shape[1], step))
        thin_line((const uint16_t *)depth->buf + row * depth->shape[1], depth->shape[1], step, target);
}

/* For each tile, whether its fingerprint is that of an earlier picture. */
WIDE_VECTORS
static void like_earlier(const uint64_t *earlier, Py_ssize_t pictures, Py_ssize_t tiles, const uint64_t *print,
                         uint64_t *found)
{
    for (Py_ssize_t i = 0; i < pictures; i++, earlier += tiles)
        for (Py_ssize_t at = 0; at < tiles; at++)
            found[at] |= (uint64_t)(earlier[at] == print[at]);
}

/* What the thinned views tell of a depth picture beside the earlier ones, as flags. The readings of its view, the
 * fingerprints of its tiles and a less thinned view are written out. */
PyObject *look_at_depth(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 15, "look_at_depth"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *depth = array_of(&arrays, args[0], "depth_mm", 'H', 2);
    Py_ssize_t step = whole_of(&arrays, args[1], "step_px", 1, 4096);
    Py_ssize_t tile_step = whole_of(&arrays, args[2], "tile_step_px", 1, 4096);
    Py_buffer *tile_of = array_of(&arrays, args[3], "tile_of", 'q', 1);
    Py_buffer *weights = array_of(&arrays, args[4], "weights", 'q', 1);
    Py_buffer *earlier = array_of(&arrays, args[5], "earlier", 'H', 2);
    Py_buffer *earlier_prints = array_of(&arrays, args[6], "earlier_prints", 'q', 2);
    Py_buffer *new_share = array_of(&arrays, args[7], "new_share", 'd', 1);
    Py_ssize_t newest = whole_of(&arrays, args[8], "newest", 0, PY_SSIZE_T_MAX);
    Py_ssize_t least_readings = whole_of(&arrays, args[9], "least_readings", 0, PY_SSIZE_T_MAX);
    double old_share = number_of(&arrays, args[10], "old_share");
    double least_new = number_of(&arrays, args[11], "least_new");
    Py_buffer *readings = output_of(&arrays, args[12], "readings", 'H', 1);
    Py_buffer *prints = output_of(&arrays, args[13], "prints", 'q', 1);
    Py_buffer *tiles = output_of(&arrays, args[14], "tiles", 'H', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = depth->shape[0], columns = depth->shape[1], n = readings->shape[0], tile_count = prints->shape[0];
    Py_ssize_t pictures = earlier->shape[0];
    require(&arrays, n == steps_in(rows, step) * steps_in(columns, step), "readings must be one for each step");
    require(&arrays, tiles->shape[0] == steps_in(rows, tile_step) && tiles->shape[1] == steps_in(columns, tile_step),
            "tiles must be one for each tile_step");
    require(&arrays, tile_of->shape[0] == n && weights->shape[0] == n && earlier->shape[1] == n,
            "tile_of, weights and earlier must be one for each reading");
    require(&arrays, earlier_prints->shape[0] == pictures && earlier_prints->shape[1] == tile_count &&
            new_share->shape[0] == tile_count, "earlier_prints and new_share must be one for each tile");
    require(&arrays, newest < pictures, "newest must be one of the pictures");
    require(&arrays, tile_count <= MOST_TILES, "there must be 64 tiles or fewer");
    if (!arrays.failed)
        require(&arrays, are_indices(tile_of, tile_count), "tile_of must be of the tiles");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    thinned(depth, step, readings->buf);
    thinned(depth, tile_step, tiles->buf);
    const uint16_t *reading = readings->buf;
    const int64_t *tile = tile_of->buf;
    const uint64_t *weight = weights->buf;
    uint64_t *print = prints->buf;
    memset(print, 0, (size_t)prints->len);
    Py_ssize_t read = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        print[tile[i]] += (uint64_t)reading[i] * weight[i];
        read += reading[i] != 0;
    }
    int seen = read ? READ : 0;
    if (read < least_readings) {
        seen |= equal_views(earlier->buf, pictures, 2 * n, newest, readings->buf);
    } else {
        Py_ssize_t most = read - (Py_ssize_t)ceil(old_share * (double)read - 1e-9);
        seen |= some_differs_little(earlier->buf, pictures, reading, n, most) ? NEARLY : 0;
    }
    uint64_t is_like[MOST_TILES] = {0};
    like_earlier(earlier_prints->buf, pictures, tile_count, print, is_like);
    for (Py_ssize_t at = 0; at < tile_count; at++)
        if (is_like[at] && print[at] != 0 && ((const double *)new_share->buf)[at] >= least_new)
            seen |= PART;
    PyObject *found = PyLong_FromLong(seen);
    PyObject *result = finish(&arrays, found == NULL ? Py_None : found);
    Py_XDECREF(found);
    return result;
}

/* The same of a colour picture: whether its thinned view was seen. */
PyObject *look_at_color(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 5, "look_at_color"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *color = array_of(&arrays, args[0], "color", 'B', 3);
    Py_ssize_t step = whole_of(&arrays, args[1], "step_px", 1, 4096);
    Py_buffer *earlier = array_of(&arrays, args[2], "earlier", 'B', 2);
    Py_ssize_t newest = whole_of(&arrays, args[3], "newest", 0, PY_SSIZE_T_MAX);
    Py_buffer *view = output_of(&arrays, args[4], "view", 'B', 1);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t rows = color->shape[0], columns = color->shape[1], channels = color->shape[2], n = view->shape[0];
    require(&arrays, n == steps_in(rows, step) * steps_in(columns, step) * channels, "view must be one for each step");
    require(&arrays, earlier->shape[1] == n && newest < earlier->shape[0], "earlier must be views of as many values");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    uint8_t *target = view->buf, any = 0;
    for (Py_ssize_t row = 0; row < rows; row += step)
        for (Py_ssize_t column = 0; column < columns; column += step)
            for (Py_ssize_t channel = 0; channel < channels; channel++) {
                uint8_t value = ((const uint8_t *)color->buf)[(row * columns + column) * channels + channel];
                any |= value;
                *target++ = value;
            }
    int seen = (any ? READ : 0) | equal_views(earlier->buf, earlier->shape[0], n, newest, view->buf);
    PyObject *found = PyLong_FromLong(seen);
    PyObject *result = finish(&arrays, found == NULL ? Py_None : found);
    Py_XDECREF(found);
    return result;
}

PyObject *is_gray(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 3, "is_gray"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *color = array_of(&arrays, args[0], "color", 'B', 3);
    Py_ssize_t equal = whole_of(&arrays, args[1], "equal", 0, 255);
    double most_equal = number_of(&arrays, args[2], "most_equal");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    require(&arrays, color->shape[2] == 3, "color must have three channels");
    if (arrays.failed)
        return finish(&arrays, Py_None);
    Py_ssize_t all = color->shape[0] * color->shape[1], coloured = 0;
    for (Py_ssize_t i = 0; i < all; i++) {
        const uint8_t *pixel = (const uint8_t *)color->buf + 3 * i;
        uint8_t least = whiteness(pixel), most = pixel[0] > pixel[1] ? pixel[0] : pixel[1];
        most = most > pixel[2] ? most : pixel[2];
        coloured += most - least > equal;
    }
    return finish(&arrays, (double)(all - coloured) / (double)all > most_equal ? Py_True : Py_False);
}
