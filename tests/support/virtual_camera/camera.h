// The camera itself: its clock, its commands and its two streams; knows nothing of OpenNI2 but what `Outlet` says.
#pragma once
#include <cerrno>
#include <condition_variable>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <sys/file.h>
#include <thread>
#include <time.h>

#include "pictures.h"

namespace xtion {

constexpr int64_t NS_PER_S = 1'000'000'000;
constexpr int64_t NAP_NS = 4'000'000;
constexpr int64_t SWITCHED_ON_US = 60'000'000;   // its clock runs already when a process finds it

inline int64_t now_ns() {
    timespec now {};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * NS_PER_S + now.tv_nsec;
}

inline void sleep_until(int64_t due_ns) {
    timespec due {due_ns / NS_PER_S, due_ns % NS_PER_S};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr);
}

// One frame on its way: made when it is due, so that waiting costs nothing.
struct Shot {
    Stream stream = DEPTH;
    int64_t due_ns = 0, index = 0, timestamp_us = 0, serial = 0;
    Recipe recipe;
    std::vector<Edit> marks;     // what befell it, for receipts and malformed heads
};

// Where frames and news go.
struct Outlet {
    std::function<void(const Shot&)> deliver;
    std::function<bool(Stream)> is_running;
    std::function<void(bool)> tell_plugged;
    std::function<void(int64_t)> tell_state;
    std::function<void()> cut_open_streams;
    std::function<void()> mend_open_streams;
};

class Camera {
public:
    Camera(Block& block, bool is_owner, const Ring& ring)
        : block_(block), ring_(ring), is_owner_(is_owner), is_plugged_(block.starts_plugged != 0) {
        if (!is_owner_) return;
        // What an earlier process was told died with it.
        auto* status = reinterpret_cast<Word*>(&block_.status);
        for (size_t i = 0; i < sizeof(Status) / sizeof(Word); i++) status[i] = 0;
        block_.taken = block_.asked.load();
        block_.status.is_plugged = is_plugged_;
        block_.status.pid = getpid();
    }

    void run(Outlet outlet) {
        outlet_ = std::move(outlet);
        begun_ns_ = next_tick_ns_ = now_ns();
        while (!ending_) {
            take_commands();
            int64_t now = now_ns();
            if (now >= next_tick_ns_) tick(now);
            deliver_due();
            int64_t wake = std::min(next_tick_ns_, now_ns() + NAP_NS);
            for (const auto& queue : waiting_) if (!queue.empty()) wake = std::min(wake, queue.front().due_ns);
            sleep_until(wake);
        }
    }
    void end() { ending_ = true; }

    bool is_plugged() const { return is_plugged_; }
    bool is_another() const { return is_another_; }
    bool is_owner() const { return is_owner_; }
    Block& block() { return block_; }
    const Ring& ring() const { return ring_; }

    // A call of the runtime into the driver: hangs for as long as that is asked for.
    void enter(Call call) {
        if (!(hanging_ & call)) return;
        block_.status.hung++;
        if (Receipt* receipt = receipt_of(hang_number_)) note_first(receipt->depth_ns, now_ns());
        while (hanging_ & call) sleep_until(now_ns() + NAP_NS);
        block_.status.hung--;
    }

private:
    Receipt* receipt_of(int64_t number) {
        Receipt& receipt = block_.receipts[number % SLOTS];
        return receipt.number == number ? &receipt : nullptr;
    }
    static void note_first(Word& word, int64_t value) { if (word == 0) word = value; }

    void take_commands() {
        if (!is_owner_) return;
        while (block_.taken < block_.asked) {
            int64_t number = block_.taken + 1;
            Receipt& receipt = block_.receipts[number % SLOTS];
            receipt.number = 0;
            for (Word* word : {&receipt.begun_ns, &receipt.depth_index, &receipt.depth_ns, &receipt.color_index,
                               &receipt.color_ns, &receipt.ended_ns}) *word = 0;
            receipt.taken_ns = now_ns();
            receipt.number = number;
            Edit asked;
            asked.command = block_.commands[number % SLOTS];
            asked.number = number;
            pending_.push_back(asked);
            block_.taken = number;
        }
    }

    bool is_streaming() const { return outlet_.is_running(DEPTH) || outlet_.is_running(COLOR); }

    void tick(int64_t now) {
        double fps = block_.fps;
        if (const Edit* rate = find(RATE)) fps = std::max(0.1, rate->command.x[0]);
        int64_t period_ns = int64_t(NS_PER_S / fps);
        // A process that was stopped finds the newest frame, not those it slept through.
        while (now - next_tick_ns_ > 2 * period_ns) { step(period_ns); block_.status.overruns++; }
        int64_t due_ns = next_tick_ns_, device_us = SWITCHED_ON_US + (next_tick_ns_ - begun_ns_) / 1000;
        bool streams = is_streaming();
        index_ = streams ? index_ + 1 : 0;
        if (!streams) endings_.clear();
        begin_and_end(streams);
        period_ns = int64_t(NS_PER_S / (find(RATE) ? std::max(0.1, find(RATE)->command.x[0]) : block_.fps));
        if (streams)
            for (Stream stream : {DEPTH, COLOR}) {
                int64_t lag_ns = stream == COLOR ? int64_t(block_.color_lag * double(period_ns)) : 0;
                shoot(stream, due_ns + lag_ns, device_us + lag_ns / 1000);
            }
        for (Edit& edit : active_) edit.age++;
        step(period_ns);
        block_.status.ticks++;
        block_.status.position = position();
    }

    void step(int64_t period_ns) {
        next_tick_ns_ += period_ns;
        const Edit* speed = find(SPEED);
        phase_ += (speed ? speed->command.x[0] : 1.0) * double(period_ns) * block_.fps / NS_PER_S;
        phase_ = std::fmod(phase_, double(ring_.frames()));
        if (phase_ < 0) phase_ += double(ring_.frames());
        serial_++;
    }
    // The smallest part of a frame too little is still this frame.
    int64_t position() const { return int64_t(phase_ + 1e-6) % ring_.frames(); }

    const Edit* find(int64_t kind) const {
        for (const Edit& edit : active_) if (edit.command.kind == kind) return &edit;
        return nullptr;
    }

    void begin_and_end(bool streams) {
        for (size_t i = 0; i < active_.size();) {
            const Edit& edit = active_[i];
            if (edit.command.for_frames > 0 && edit.age >= edit.command.for_frames) finish(i); else i++;
        }
        std::vector<Edit> later;
        for (Edit& edit : pending_) {
            if (streams && edit.command.from_frame > index_) { later.push_back(edit); continue; }
            if (Receipt* receipt = receipt_of(edit.number)) receipt->begun_ns = now_ns();
            if (edit.command.kind == UNDO) { undo(edit); continue; }
            edit.age = 0;
            active_.push_back(edit);
            begin(active_.back());
        }
        pending_ = std::move(later);
    }

    void undo(const Edit& order) {
        for (size_t i = 0; i < active_.size();)
            if (order.command.n[0] == 0 || active_[i].number == order.command.n[0]) finish(i); else i++;
        endings_.push_back(order);
    }

    void begin(Edit& edit) {
        const Command& c = edit.command;
        switch (c.kind) {
        case UNPLUG:
            is_plugged_ = false;
            block_.status.is_plugged = 0;
            outlet_.cut_open_streams();
            if (c.n[0]) outlet_.tell_plugged(false);
            break;
        case STATE: outlet_.tell_state(c.n[0]); break;
        case HANG: hang_number_ = edit.number; hanging_ = c.n[0]; break;
        case SPEED: if (c.n[0] >= 0) phase_ = double(c.n[0] % ring_.frames()); break;
        default: break;
        }
    }

    void finish(size_t at) {
        Edit edit = active_[at];
        active_.erase(active_.begin() + long(at));
        switch (edit.command.kind) {
        case UNPLUG:
            is_plugged_ = true;
            is_another_ = edit.command.n[2] != 0;
            block_.status.is_plugged = 1;
            if (edit.command.n[1]) outlet_.mend_open_streams();
            if (edit.command.n[0]) outlet_.tell_plugged(true);
            break;
        case STATE: outlet_.tell_state(0); break;
        case HANG: hanging_ = 0; break;
        default: break;
        }
        if (Receipt* receipt = receipt_of(edit.number)) receipt->ended_ns = now_ns();
    }

    void shoot(Stream stream, int64_t due_ns, int64_t device_us) {
        Shot shot;
        shot.stream = stream;
        shot.due_ns = due_ns;
        shot.index = index_;
        shot.timestamp_us = device_us;
        shot.serial = ++shots_;
        shot.recipe.seed = serial_;
        shot.recipe.position = position();
        shot.recipe.neighbour = (shot.recipe.position + 1) % ring_.frames();
        shot.recipe.is_mixed = find(SPEED) != nullptr;
        bool is_lost = false;
        const int64_t bit = 1 << stream;
        for (Edit& ending : endings_) shot.marks.push_back(ending);
        for (const Edit& edit : active_) {
            const Command& c = edit.command;
            if (!(c.streams & bit)) continue;
            shot.marks.push_back(edit);
            is_lost |= change(shot, edit, device_us);
        }
        if (stream == COLOR) endings_.clear();
        if (is_lost || !is_plugged_) { note(shot, shot.due_ns); return; }
        const Shot& last = last_[stream];
        if (has(shot, AGAIN) && last.index > 0) {
            shot.recipe = last.recipe; shot.index = last.index; shot.timestamp_us = last.timestamp_us;
        } else if (has(shot, REPEAT) && last.index > 0) {
            shot.recipe = last.recipe;
        }
        last_[stream] = shot;
        if (has(shot, LATE)) note(shot, due_ns);   // the cause is when it should have come
        auto& queue = waiting_[stream];
        if (!queue.empty()) shot.due_ns = std::max(shot.due_ns, queue.back().due_ns);
        queue.push_back(std::move(shot));
        block_.status.backlog = int64_t(queue.size());
    }

    static bool has(const Shot& shot, int64_t kind) {
        for (const Edit& edit : shot.marks) if (edit.command.kind == kind) return true;
        return false;
    }

    // What one command does to a frame; true when the frame is lost.
    bool change(Shot& shot, const Edit& edit, int64_t device_us) {
        const Command& c = edit.command;
        switch (c.kind) {
        case STALL: return true;
        case STATE: return c.n[1] == 0;
        case LATE: shot.due_ns += int64_t((c.x[0] + c.x[1] * double(edit.age)) * 1e6); break;
        case CLOCK: shot.timestamp_us += c.n[0]; break;
        case STUCK_CLOCK: {
            auto [at, is_new] = stuck_us_.try_emplace({edit.number, shot.stream}, last_[shot.stream].timestamp_us);
            if (is_new && at->second == 0) at->second = device_us;
            shot.timestamp_us = at->second;
            break;
        }
        case TIMESTAMP: shot.timestamp_us = c.n[0]; break;
        case INDEX: shot.index += c.n[0]; break;
        default: if ((c.kind >= FILL && c.kind <= SHIFT) || c.kind >= TORN) shot.recipe.edits.push_back(edit);
        }
        return false;
    }

    void deliver_due() {
        for (auto& queue : waiting_)
            while (!queue.empty() && queue.front().due_ns <= now_ns()) {
                Shot shot = std::move(queue.front());
                queue.pop_front();
                outlet_.deliver(shot);
            }
    }

public:
    // Just before a frame is handed to the runtime; or when it would have been.
    void note(const Shot& shot, int64_t at_ns) {
        for (const Edit& edit : shot.marks) {
            Receipt* receipt = receipt_of(edit.number);
            if (!receipt) continue;
            Word& when = shot.stream == DEPTH ? receipt->depth_ns : receipt->color_ns;
            if (when != 0 || edit.command.kind == HANG) continue;
            (shot.stream == DEPTH ? receipt->depth_index : receipt->color_index) = shot.index;
            when = at_ns;
        }
    }

private:
    Block& block_;
    const Ring& ring_;
    bool is_owner_;
    std::atomic<bool> is_plugged_, ending_ {false}, is_another_ {false};
    std::atomic<int64_t> hanging_ {0}, hang_number_ {0};
    Outlet outlet_;
    int64_t begun_ns_ = 0, next_tick_ns_ = 0, index_ = 0, serial_ = 0, shots_ = 0;
    double phase_ = 0.0;
    std::vector<Edit> pending_, active_, endings_;
    std::deque<Shot> waiting_[2];
    Shot last_[2];
    std::map<std::pair<int64_t, int>, int64_t> stuck_us_;
};

}  // namespace xtion
