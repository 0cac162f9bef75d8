// Baked frames, and what is done to them before they are delivered. Everything random follows from a frame's number, so
// that the same recipe gives the same picture.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstring>
#include <fcntl.h>
#include <string>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#include <vector>

#include "block.h"

namespace xtion {

constexpr int W = 640, H = 480, PIXELS = W * H;
constexpr size_t DEPTH_BYTES = PIXELS * 2, COLOR_BYTES = PIXELS * 3;

class Random {
public:
    explicit Random(uint64_t seed) : state_(seed * 0x9e3779b97f4a7c15u + 0x632be59bd9b4e019u) {}
    uint32_t next() {
        state_ ^= state_ << 13; state_ ^= state_ >> 7; state_ ^= state_ << 17;
        return static_cast<uint32_t>(state_ >> 32);
    }
    double share() { return next() * (1.0 / 4294967296.0); }
private:
    uint64_t state_;
};

// One thing that is done to frames, as it was asked for, and how long it has gone on.
struct Edit {
    Command command;
    int64_t number = 0;
    int64_t age = 0;   // frames since it began
};

// What one frame shows.
struct Recipe {
    int64_t seed = 0;
    int64_t position = 0, neighbour = 0;   // baked frames; pixels are taken from either
    bool is_mixed = false;
    std::vector<Edit> edits;
};

class Ring {
public:
    explicit Ring(const std::string& path) {
        int fd = open(path.c_str(), O_RDONLY);
        struct stat about {};
        if (fd < 0 || fstat(fd, &about) != 0) return;
        void* at = mmap(nullptr, about.st_size, PROT_READ, MAP_SHARED, fd, 0);
        close(fd);
        if (at == MAP_FAILED) return;
        auto* head = static_cast<const RingHead*>(at);
        bool is_whole = head->magic == MAGIC && head->width == W && head->height == H && head->frames > 0 &&
                        head->frames_at + head->frames * int64_t(DEPTH_BYTES + COLOR_BYTES) <= about.st_size;
        if (!is_whole) return;
        head_ = head;
        bytes_ = static_cast<const uint8_t*>(at);
        make_nearest();
    }
    bool is_there() const { return head_ != nullptr; }
    const RingHead& head() const { return *head_; }
    int64_t frames() const { return head_->frames; }
    const uint16_t* depth(int64_t frame) const { return reinterpret_cast<const uint16_t*>(at(frame)); }
    const uint8_t* color(int64_t frame) const { return at(frame) + DEPTH_BYTES; }
    const float* rays() const { return reinterpret_cast<const float*>(bytes_ + head_->rays_at); }
    // A reading the sensor could give near mm: the one below or above, the nearer more often.
    uint16_t reading(double mm, Random& random) const {
        if (mm <= lowest_ || mm >= 9500.0) return 0;
        double low = below_[static_cast<int>(mm)], high = above_[static_cast<int>(mm)];
        if (high <= low) return static_cast<uint16_t>(low);
        return static_cast<uint16_t>(random.share() < (mm - low) / (high - low) ? high : low);
    }

private:
    const uint8_t* at(int64_t frame) const {
        return bytes_ + head_->frames_at + (frame % frames()) * (DEPTH_BYTES + COLOR_BYTES);
    }
    void make_nearest() {
        std::vector<uint16_t> table(head_->depth_table_mm, head_->depth_table_mm + 2048);
        table.erase(std::remove(table.begin(), table.end(), 0), table.end());
        std::sort(table.begin(), table.end());
        lowest_ = table.front();
        for (int mm = 0; mm < 9600; mm++) {
            auto next = std::upper_bound(table.begin(), table.end(), mm);
            below_[mm] = next == table.begin() ? table.front() : *(next - 1);
            above_[mm] = next == table.end() ? table.back() : *next;
        }
    }
    const RingHead* head_ = nullptr;
    const uint8_t* bytes_ = nullptr;
    uint16_t below_[9600] = {}, above_[9600] = {};
    double lowest_ = 0.0;
};

struct Area { int left, top, right, bottom; };

inline Area area_of(const Command& command) {
    const int64_t* n = command.n;
    if (n[2] <= 0 || n[3] <= 0) return {0, 0, W, H};
    auto clip = [](int64_t value, int high) { return static_cast<int>(std::clamp<int64_t>(value, 0, high)); };
    return {clip(n[0], W), clip(n[1], H), clip(n[0] + n[2], W), clip(n[1] + n[3], H)};
}

template <class Do> void each(const Area& area, Do&& act) {
    for (int row = area.top; row < area.bottom; row++)
        for (int column = area.left; column < area.right; column++) act(row * W + column);
}

template <int CHANNELS, class T> void shift(std::vector<T>& picture, const Area& area, int64_t right, int64_t down) {
    std::vector<T> before = picture;
    each(area, [&](int pixel) {
        int64_t row = std::clamp<int64_t>(pixel / W - down, 0, H - 1), column = std::clamp<int64_t>(pixel % W - right, 0, W - 1);
        std::memcpy(&picture[pixel * CHANNELS], &before[(row * W + column) * CHANNELS], CHANNELS * sizeof(T));
    });
}

// Makes pictures in the camera's full size, not registered, not mirrored.
class Darkroom {
public:
    explicit Darkroom(const Ring& ring) : ring_(ring), depth_(PIXELS), color_(COLOR_BYTES), registered_(PIXELS) {}

    const std::vector<uint16_t>& depth(const Recipe& recipe) {
        const uint16_t *one = ring_.depth(recipe.position), *other = ring_.depth(recipe.neighbour);
        std::memcpy(depth_.data(), one, DEPTH_BYTES);
        if (recipe.is_mixed) mix(recipe, [&](int pixel) { depth_[pixel] = other[pixel]; });
        for (const Edit& edit : recipe.edits)
            if (edit.command.streams & 1) edit_depth(edit, recipe);
        return depth_;
    }

    const std::vector<uint8_t>& color(const Recipe& recipe) {
        const uint8_t *one = ring_.color(recipe.position), *other = ring_.color(recipe.neighbour);
        std::memcpy(color_.data(), one, COLOR_BYTES);
        if (recipe.is_mixed) mix(recipe, [&](int pixel) { std::memcpy(&color_[3 * pixel], other + 3 * pixel, 3); });
        for (const Edit& edit : recipe.edits)
            if (edit.command.streams & 2) edit_color(edit, recipe);
        return color_;
    }

    // Depth seen by the colour camera, the nearest where several pixels fall on one.
    const std::vector<uint16_t>& registered(const std::vector<uint16_t>& depth) {
        const RingHead& head = ring_.head();
        const float* ray = ring_.rays();
        const double *k = head.distortion, *t = head.translation_mm;
        std::fill(registered_.begin(), registered_.end(), 0);
        for (int pixel = 0; pixel < PIXELS; pixel++, ray += 3) {
            double z = depth[pixel];
            if (z == 0.0) continue;
            double deep = ray[2] * z + t[2], x = (ray[0] * z + t[0]) / deep, y = (ray[1] * z + t[1]) / deep;
            double r2 = x * x + y * y, bend = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
            double u = x * bend + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x);
            double v = y * bend + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y;
            int column = int(std::lround(head.color_fx * u + head.color_cx));
            int row = int(std::lround(head.color_fy * v + head.color_cy));
            if (column < 0 || column >= W || row < 0 || row >= H) continue;
            uint16_t& there = registered_[row * W + column];
            if (there == 0 || depth[pixel] < there) there = depth[pixel];
        }
        return registered_;
    }

private:
    template <class Take> void mix(const Recipe& recipe, Take&& take) {
        Random random(recipe.seed);
        for (int pixel = 0; pixel < PIXELS; pixel += 32) {
            uint32_t bits = random.next();
            for (int bit = 0; bit < 32; bit++)
                if (bits >> bit & 1u) take(pixel + bit);
        }
    }

    // A position of the film that was shown so many frames before.
    int64_t before(const Recipe& recipe, int64_t frames) const {
        const int64_t all = ring_.frames();
        return ((recipe.position - frames) % all + all) % all;
    }

    void average(const Recipe& recipe, int64_t frames) {
        std::vector<int64_t> sums(PIXELS, 0), seen(PIXELS, 0);
        for (int64_t ago = 0; ago < frames; ago++) {
            const uint16_t* one = ring_.depth(before(recipe, ago));
            for (int pixel = 0; pixel < PIXELS; pixel++) { sums[pixel] += one[pixel]; seen[pixel] += one[pixel] > 0; }
        }
        for (int pixel = 0; pixel < PIXELS; pixel++)
            depth_[pixel] = seen[pixel] == frames ? uint16_t((sums[pixel] + frames / 2) / frames) : 0;
    }

    void edit_depth(const Edit& edit, const Recipe& recipe) {
        const Command& c = edit.command;
        Area area = area_of(c);
        Random random(uint64_t(recipe.seed) * 31 + uint64_t(edit.number));
        switch (c.kind) {
        case FILL:
            if (c.n[4] >= 0) each(area, [&](int pixel) { depth_[pixel] = uint16_t(c.n[4]); });
            break;
        case OFFSET: {
            double mm = c.x[0];
            if (c.x[1] != 0.0) mm = std::copysign(std::min(std::fabs(mm), std::fabs(c.x[1]) * double(edit.age + 1)), mm);
            each(area, [&](int pixel) {
                if (depth_[pixel]) depth_[pixel] = ring_.reading(depth_[pixel] + (c.n[4] ? mm * depth_[pixel] / 1000.0 : mm), random);
            });
            break;
        }
        case DROPOUT: {
            Random same(uint64_t(edit.number) + 77);
            Random& which = c.n[4] ? same : random;
            each(area, [&](int pixel) { if (which.share() < c.x[0]) depth_[pixel] = 0; });
            break;
        }
        case NOISE:
            each(area, [&](int pixel) { depth_[pixel] = uint16_t(c.n[4] + random.share() * double(c.n[5] - c.n[4])); });
            break;
        case SHIFT: shift<1>(depth_, area, c.n[4], c.n[5]); break;
        case TORN: std::copy_n(ring_.depth(before(recipe, c.n[1])) + c.n[0] * W, PIXELS - c.n[0] * W, &depth_[c.n[0] * W]); break;
        case AVERAGED: average(recipe, c.n[0]); break;
        default: break;
        }
    }

    void edit_color(const Edit& edit, const Recipe& recipe) {
        const Command& c = edit.command;
        Area area = area_of(c);
        Random random(uint64_t(recipe.seed) * 37 + uint64_t(edit.number));
        switch (c.kind) {
        case FILL:
            if (c.n[5] >= 0)
                each(area, [&](int pixel) {
                    for (int channel = 0; channel < 3; channel++)
                        color_[3 * pixel + channel] = uint8_t(c.n[5] >> (16 - 8 * channel));
                });
            break;
        case NOISE:
            each(area, [&](int pixel) {
                uint32_t bits = random.next();
                std::memcpy(&color_[3 * pixel], &bits, 3);
            });
            break;
        case SHIFT: shift<3>(color_, area, c.n[4], c.n[5]); break;
        case TORN: {
            const int64_t from = 3 * c.n[0] * W;
            std::copy_n(ring_.color(before(recipe, c.n[1])) + from, COLOR_BYTES - from, &color_[from]);
            break;
        }
        default: break;
        }
    }

    const Ring& ring_;
    std::vector<uint16_t> depth_;
    std::vector<uint8_t> color_;
    std::vector<uint16_t> registered_;
};

}  // namespace xtion
