/* 16zT bytes to a depth picture; engine/capture/oni/codec.py describes the bytes, unpacking.py is the numpy form. */
#include "arguments.h"

#include <string.h>

enum { STEPS, RUN, LONG, STEP_AND_LONG };
#define SHORT 16 /* pixels that most runs do not exceed */
#define MARGIN 64 /* no run is as long */
#define RANKS 65536

typedef struct {
    int8_t first, second;
    uint8_t pixels, kind;
} Code;

static Code codes_table[256];

static void prepare(void)
{
    for (int code = 0; code < 256; code++) {
        Code *entry = &codes_table[code];
        int low = code & 15, high = code >> 4;
        memset(entry, 0, sizeof *entry);
        if (code == 0xFF) {
            entry->kind = LONG;
        } else if (code >= 0xE0) {
            entry->kind = RUN;
            entry->pixels = (uint8_t)(2 * (code - 0xE0));
        } else {
            entry->kind = low == 15 ? STEP_AND_LONG : STEPS;
            entry->first = (int8_t)(6 - high);
            entry->second = (int8_t)(low == 13 || low == 15 ? 0 : 6 - low);
            entry->pixels = low == 13 ? 1 : 2;
        }
    }
}

static uint16_t word_at(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] | bytes[1] << 8);
}

/* Read the argument of a long step into the rank; the bytes used, or 0 where they are cut. */
static size_t long_step(const uint8_t *at, const uint8_t *end, uint16_t *rank)
{
    if (at >= end)
        return 0;
    if (*at >= 0x80) {
        *rank = (uint16_t)(*rank + 192 - *at);
        return 1;
    }
    if (end - at < 2)
        return 0;
    *rank = (uint16_t)(at[0] << 8 | at[1]);
    return 2;
}

/* 1 if these bytes are such a picture. Ranks wrap at 16 bit; the table has an entry for each of them. */
static int decode(const uint8_t *data, size_t size, uint16_t *out, size_t pixels, uint16_t *table)
{
    if (size < 4 || pixels < 1)
        return 0;
    size_t ranks = word_at(data);
    if (size / 2 < ranks + 2)
        return 0;
    for (size_t i = 0; i < ranks; i++)
        table[i] = word_at(data + 2 + 2 * i);
    memset(table + ranks, 0, (RANKS - ranks) * sizeof *table);
    const uint8_t *at = data + 2 * ranks + 4, *end = data + size;
    if ((size_t)(end - at) > 3 * pixels)
        return 0;
    uint16_t rank = word_at(data + 2 * ranks + 2);
    unsigned highest = rank;
    size_t done = 1;
    out[0] = table[rank];
    while (at < end) {
        Code code = codes_table[*at++];
        if (code.kind <= RUN && pixels - done >= MARGIN) {
            /* Steps and runs alike, as no branch can be foretold here. What is written too far is written over. */
            uint16_t first = (uint16_t)(rank + code.first);
            rank = (uint16_t)(first + code.second);
            uint16_t value = table[rank];
            for (int i = 0; i < SHORT; i++)
                out[done + i] = value;
            out[done] = table[first];
            if (code.pixels > SHORT)
                for (int i = SHORT; i < MARGIN; i++)
                    out[done + i] = value;
            highest = first > highest ? first : highest;
            highest = rank > highest ? rank : highest;
            done += code.pixels;
            continue;
        }
        if (code.kind == RUN) {
            if (code.pixels > pixels - done)
                return 0;
            for (int i = 0; i < code.pixels; i++)
                out[done++] = table[rank];
            continue;
        }
        if (code.kind != LONG) { /* one step; then another, or a long one, or none */
            if (done >= pixels)
                return 0;
            rank = (uint16_t)(rank + code.first);
            highest = rank > highest ? rank : highest;
            out[done++] = table[rank];
        }
        if (code.kind == STEPS) {
            if (code.pixels == 1)
                continue;
            rank = (uint16_t)(rank + code.second);
        } else {
            size_t used = long_step(at, end, &rank);
            if (!used)
                return 0;
            at += used;
        }
        if (done >= pixels)
            return 0;
        highest = rank > highest ? rank : highest;
        out[done++] = table[rank];
    }
    return done == pixels && highest < ranks;
}

PyObject *decode_16zt(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (!counted(count, 2, "decode_16zt"))
        return NULL;
    Arrays arrays = {0};
    Py_buffer *payload = bytes_of(&arrays, args[0], "payload");
    Py_buffer *picture = output_of(&arrays, args[1], "picture", 'H', 2);
    if (arrays.failed)
        return finish(&arrays, Py_None);
    uint16_t *table = PyMem_RawMalloc(RANKS * sizeof *table);
    if (table == NULL) {
        arrays.failed = 1;
        PyErr_NoMemory();
        return finish(&arrays, Py_None);
    }
    if (codes_table[0].pixels == 0)
        prepare();
    int is_decoded;
    Py_BEGIN_ALLOW_THREADS
    is_decoded = decode(payload->buf, (size_t)payload->len, picture->buf, (size_t)(picture->len / 2), table);
    Py_END_ALLOW_THREADS
    PyMem_RawFree(table);
    return finish(&arrays, is_decoded ? Py_True : Py_False);
}
