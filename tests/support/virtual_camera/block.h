// What driver and controller share: one mapped file. tests/support/virtual_camera/block.py says the same in ctypes; sizes are compared.
//
// The controller writes a whole command into its slot and then raises `asked`; the driver reads `asked` and then the
// slot. Each number is one aligned word, written by one side alone, so nothing is ever seen half-written.
#pragma once
#include <atomic>
#include <cstdint>

namespace xtion {

constexpr int64_t MAGIC = 0x6e6f697458314456;
constexpr int64_t VERSION = 1;
constexpr int SLOTS = 256;

using Word = std::atomic<int64_t>;
static_assert(sizeof(Word) == 8 && Word::is_always_lock_free);

enum Stream { DEPTH = 0, COLOR = 1 };

enum Kind : int64_t {
    UNDO = 0,       // n0 command's number; 0 is all
    STALL = 1,      // nothing is delivered; numbers and times go on
    REPEAT = 2,     // the picture before, with new times
    AGAIN = 3,      // the frame before: its picture, number and time
    LATE = 4,       // x0 ms late, and x1 ms more each frame
    RATE = 5,       // x0 frames a second
    CLOCK = 6,      // n0 us are added to times
    STUCK_CLOCK = 7,
    TIMESTAMP = 8,  // times are n0
    INDEX = 9,      // n0 is added to frame numbers
    MALFORM = 10,   // n0 what (Field), n1 its value
    STATE = 11,     // n0 device state told; n1 = 1: goes on delivering
    UNPLUG = 12,    // n0 = 1: told; n1 = 1: open streams go on when it is plugged in again; n2 = 1: another comes back
    HANG = 13,      // n0 calls (Call)
    FILL = 20,      // rectangle n0..n3, n4 depth in mm or -1, n5 RGB or -1
    OFFSET = 21,    // rectangle n0..n3, x0 mm, x1 mm a frame until then (0: at once), n4 = 1: for each metre of depth
    DROPOUT = 22,   // rectangle n0..n3, x0 share of pixels that read nothing, n4 = 1: the same ones each frame
    NOISE = 23,     // rectangle n0..n3, n4..n5 mm at random
    SHIFT = 24,     // rectangle n0..n3 of the new picture (0: all), n4, n5 px to the right and down
    SPEED = 25,     // x0 times as fast; n0 position to go to first, or -1
    TORN = 26,      // from row n0 on the picture of n1 frames before
    AVERAGED = 27,  // the mean of the last n0 pictures' depths, where each has one
};

enum Field : int64_t { DATA_SIZE = 1, WIDTH = 2, HEIGHT = 3, STRIDE = 4, SENSOR = 5, FORMAT = 6, NO_DATA = 7 };

enum Call : int64_t {
    ON_OPEN = 1, ON_CLOSE = 2, ON_START = 4, ON_STOP = 8, ON_SET = 16, ON_GET = 32, ON_READ = 64, ON_DESTROY = 128,
};

struct Command {
    int64_t kind;
    int64_t streams;      // 1 depth, 2 colour, 3 both
    int64_t from_frame;   // the frame number that is affected first; 0 is the next
    int64_t for_frames;   // so many; 0 until undone
    int64_t n[8];
    double x[4];
};

struct Receipt {
    Word number;          // whose it is
    Word taken_ns;        // host CLOCK_MONOTONIC, as all
    Word begun_ns;
    Word depth_index, depth_ns;  // the first affected frame, when it was raised, or would have been
    Word color_index, color_ns;
    Word ended_ns;
};

struct Status {
    Word pid, ticks, is_plugged, is_open;
    Word is_running[2], raised[2], index[2], timestamp_us[2], raised_ns[2], mirrored[2], width_px[2];
    Word registration, position, backlog, overruns, hung, refused_frames;
};

struct Block {
    int64_t magic, version, size;
    char ring_path[1024];
    int64_t starts_plugged, can_register;
    double fps, color_lag;      // colour comes this share of a period after depth
    Word asked, taken;
    Status status;
    Receipt receipts[SLOTS];
    Command commands[SLOTS];
};

// A file of baked frames: this head, then at `frames_at` one depth and one colour picture each, one after the other.
struct RingHead {
    int64_t magic, frames, width, height, frames_at, rays_at;
    double color_fx, color_fy, color_cx, color_cy, distortion[5], translation_mm[3];
    double depth_fx, depth_fy;
    uint16_t depth_table_mm[2048];
};

}  // namespace xtion
