// A virtual Xtion: an OpenNI2 driver for tests. It appears in the real runtime as a live device with depth and colour,
// plays baked frames in a loop, and does what the file named by VIRTUAL_XTION tells it; see docs/5-evidence/xtion.md.
#define XN_NEW(T, ...) new T(__VA_ARGS__)
#define XN_DELETE(p) delete (p)
#include <OniCTypes.h>
#include <Driver/OniDriverAPI.h>

#include <chrono>
#include <cstdlib>

#include "camera.h"

using namespace xtion;

namespace {

constexpr const char* URI = "virtual/xtion";
constexpr int64_t STOP_PATIENCE_MS = 2000;

template <class T> OniStatus give(const T& value, void* data, int* size) {
    if (*size < int(sizeof(T))) return ONI_STATUS_BAD_PARAMETER;
    std::memcpy(data, &value, sizeof(T));
    *size = sizeof(T);
    return ONI_STATUS_OK;
}

OniVideoMode MODES[2][2] = {
    {{ONI_PIXEL_FORMAT_DEPTH_1_MM, 640, 480, 30}, {ONI_PIXEL_FORMAT_DEPTH_1_MM, 320, 240, 30}},
    {{ONI_PIXEL_FORMAT_RGB888, 640, 480, 30}, {ONI_PIXEL_FORMAT_RGB888, 320, 240, 30}},
};
OniSensorInfo SENSORS[2] = {{ONI_SENSOR_DEPTH, 2, MODES[DEPTH]}, {ONI_SENSOR_COLOR, 2, MODES[COLOR]}};

class VirtualStream : public oni::driver::StreamBase {
public:
    VirtualStream(Camera& camera, Stream kind) : camera_(camera), kind_(kind), mode_(MODES[kind][0]) { tell(); }

    OniStatus start() override {
        camera_.enter(ON_START);
        if (!camera_.is_plugged()) return ONI_STATUS_NO_DEVICE;
        std::lock_guard lock(mutex_);
        is_running_ = true;
        camera_.block().status.is_running[kind_] = 1;
        return ONI_STATUS_OK;
    }
    void stop() override {
        camera_.enter(ON_STOP);
        halt();
    }
    void halt() {
        std::unique_lock lock(mutex_);
        is_running_ = false;
        camera_.block().status.is_running[kind_] = 0;
        raised_.wait_for(lock, std::chrono::milliseconds(STOP_PATIENCE_MS), [&] { return !is_raising_; });
    }

    OniStatus setProperty(int id, const void* data, int size) override {
        camera_.enter(ON_SET);
        std::lock_guard lock(mutex_);
        if (id == ONI_STREAM_PROPERTY_MIRRORING && size == int(sizeof(OniBool))) {
            is_mirrored_ = *static_cast<const OniBool*>(data) != 0;
            tell();
            return ONI_STATUS_OK;
        }
        if (id == ONI_STREAM_PROPERTY_VIDEO_MODE && size == int(sizeof(OniVideoMode))) {
            OniVideoMode wanted = *static_cast<const OniVideoMode*>(data);
            for (const OniVideoMode& mode : MODES[kind_])
                if (std::memcmp(&mode, &wanted, sizeof mode) == 0 && !is_running_) {
                    mode_ = wanted;
                    tell();
                    return ONI_STATUS_OK;
                }
            return ONI_STATUS_BAD_PARAMETER;
        }
        return ONI_STATUS_NOT_SUPPORTED;
    }

    OniStatus getProperty(int id, void* data, int* size) override {
        camera_.enter(ON_GET);
        const RingHead& head = camera_.ring().head();
        double fx = kind_ == DEPTH ? head.depth_fx : head.color_fx, fy = kind_ == DEPTH ? head.depth_fy : head.color_fy;
        std::lock_guard lock(mutex_);
        switch (id) {
        case ONI_STREAM_PROPERTY_HORIZONTAL_FOV: return give(float(2 * std::atan(W / 2 / fx)), data, size);
        case ONI_STREAM_PROPERTY_VERTICAL_FOV: return give(float(2 * std::atan(H / 2 / fy)), data, size);
        case ONI_STREAM_PROPERTY_VIDEO_MODE: return give(mode_, data, size);
        case ONI_STREAM_PROPERTY_MIRRORING: return give(OniBool(is_mirrored_), data, size);
        case ONI_STREAM_PROPERTY_MAX_VALUE: return kind_ == DEPTH ? give(int(10000), data, size) : ONI_STATUS_NOT_SUPPORTED;
        case ONI_STREAM_PROPERTY_MIN_VALUE: return kind_ == DEPTH ? give(int(0), data, size) : ONI_STATUS_NOT_SUPPORTED;
        default: return ONI_STATUS_NOT_SUPPORTED;
        }
    }
    OniBool isPropertySupported(int id) override {
        return id == ONI_STREAM_PROPERTY_HORIZONTAL_FOV || id == ONI_STREAM_PROPERTY_VERTICAL_FOV ||
               id == ONI_STREAM_PROPERTY_VIDEO_MODE || id == ONI_STREAM_PROPERTY_MIRRORING ||
               (kind_ == DEPTH && (id == ONI_STREAM_PROPERTY_MAX_VALUE || id == ONI_STREAM_PROPERTY_MIN_VALUE));
    }
    int getRequiredFrameSize() override { return mode_.resolutionX * mode_.resolutionY * bytes_a_pixel(); }

    // On the camera's thread alone: a stream that was reserved stays until its frame is out, however it is stopped.
    bool reserve() {
        std::lock_guard lock(mutex_);
        is_raising_ = is_running();
        return is_raising_;
    }
    void raise_reserved(const Shot& shot, Darkroom& darkroom, bool is_registered) {
        raise(shot, darkroom, is_registered);
        std::lock_guard lock(mutex_);
        is_raising_ = false;
        raised_.notify_all();
    }

    bool is_running() const { return is_running_ && !is_cut_; }
    // Unplugged while it ran: started, and silent.
    void cut(bool is_cut) {
        std::lock_guard lock(mutex_);
        is_cut_ = is_cut;
        camera_.block().status.is_running[kind_] = is_running();
    }

private:
    int bytes_a_pixel() const { return kind_ == DEPTH ? 2 : 3; }
    void tell() {
        camera_.block().status.mirrored[kind_] = is_mirrored_;
        camera_.block().status.width_px[kind_] = mode_.resolutionX;
    }

    void raise(const Shot& shot, Darkroom& darkroom, bool is_registered) {
        OniFrame* frame = getServices().acquireFrame();
        if (frame == nullptr) { camera_.block().status.refused_frames++; return; }
        const OniVideoMode mode = mode_;   // fixed while it runs
        if (frame->data == nullptr) { frame->data = withheld_; withheld_ = nullptr; }  // given without, and come back
        const uint8_t* picture = nullptr;
        if (kind_ == DEPTH) {
            const auto& depth = darkroom.depth(shot.recipe);
            picture = reinterpret_cast<const uint8_t*>((is_registered ? darkroom.registered(depth) : depth).data());
        } else {
            picture = darkroom.color(shot.recipe).data();
        }
        fit(picture, static_cast<uint8_t*>(frame->data), mode, is_mirrored_);
        frame->dataSize = mode.resolutionX * mode.resolutionY * bytes_a_pixel();
        frame->sensorType = SENSORS[kind_].sensorType;
        frame->timestamp = uint64_t(shot.timestamp_us);
        frame->frameIndex = int(shot.index);
        frame->width = mode.resolutionX;
        frame->height = mode.resolutionY;
        frame->videoMode = mode;
        frame->croppingEnabled = FALSE;
        frame->cropOriginX = frame->cropOriginY = 0;
        frame->stride = mode.resolutionX * bytes_a_pixel();
        for (const Edit& edit : shot.marks)
            if (edit.command.kind == MALFORM) malform(*frame, edit.command);
        Status& status = camera_.block().status;
        int64_t at_ns = now_ns();
        camera_.note(shot, at_ns);
        status.index[kind_] = shot.index;
        status.timestamp_us[kind_] = shot.timestamp_us;
        status.raised_ns[kind_] = at_ns;
        status.raised[kind_]++;
        raiseNewFrame(frame);
        getServices().releaseFrame(frame);
    }

    void fit(const uint8_t* from, uint8_t* to, const OniVideoMode& mode, bool is_mirrored) const {
        const int size = bytes_a_pixel(), every = W / mode.resolutionX;
        if (every == 1 && !is_mirrored) { std::memcpy(to, from, size_t(PIXELS) * size); return; }
        for (int row = 0; row < mode.resolutionY; row++)
            for (int column = 0; column < mode.resolutionX; column++) {
                int seen = is_mirrored ? W - 1 - column * every : column * every;
                std::memcpy(to, from + (size_t(row) * every * W + seen) * size, size);
                to += size;
            }
    }

    void malform(OniFrame& frame, const Command& command) {
        const int value = int(command.n[1]);
        switch (command.n[0]) {
        case DATA_SIZE: frame.dataSize = value; break;
        case WIDTH: frame.width = value; break;
        case HEIGHT: frame.height = value; break;
        case STRIDE: frame.stride = value; break;
        case SENSOR: frame.sensorType = OniSensorType(value); break;
        case FORMAT: frame.videoMode.pixelFormat = OniPixelFormat(value); break;
        case NO_DATA: withheld_ = frame.data; frame.data = nullptr; break;
        default: break;
        }
    }

    Camera& camera_;
    const Stream kind_;
    OniVideoMode mode_;
    std::mutex mutex_;
    std::condition_variable raised_;
    std::atomic<bool> is_running_ {false}, is_cut_ {false};
    std::atomic<bool> is_mirrored_ {true};   // by itself, as an Xtion is
    bool is_raising_ = false;
    void* withheld_ = nullptr;
};

class VirtualDevice : public oni::driver::DeviceBase {
public:
    explicit VirtualDevice(Camera& camera) : camera_(camera) {}

    OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override {
        *sensors = SENSORS;
        *count = 2;
        return ONI_STATUS_OK;
    }
    oni::driver::StreamBase* createStream(OniSensorType sensor) override {
        if (sensor != ONI_SENSOR_DEPTH && sensor != ONI_SENSOR_COLOR) return nullptr;
        Stream kind = sensor == ONI_SENSOR_DEPTH ? DEPTH : COLOR;
        std::lock_guard lock(mutex_);
        if (streams_[kind] != nullptr) return nullptr;
        return streams_[kind] = new VirtualStream(camera_, kind);
    }
    void destroyStream(oni::driver::StreamBase* stream) override {
        camera_.enter(ON_DESTROY);
        static_cast<VirtualStream*>(stream)->halt();
        std::lock_guard lock(mutex_);
        for (auto& one : streams_) if (one == stream) one = nullptr;
        delete stream;
    }
    OniStatus setProperty(int id, const void* data, int size) override {
        camera_.enter(ON_SET);
        if (id != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION || size != int(sizeof(int))) return ONI_STATUS_NOT_SUPPORTED;
        int mode = *static_cast<const int*>(data);
        if (!isImageRegistrationModeSupported(OniImageRegistrationMode(mode))) return ONI_STATUS_NOT_SUPPORTED;
        is_registered_ = mode == ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR;
        camera_.block().status.registration = is_registered_;
        return ONI_STATUS_OK;
    }
    OniStatus getProperty(int id, void* data, int* size) override {
        camera_.enter(ON_GET);
        if (id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION) return give(int(is_registered_), data, size);
        char serial[] = "VIRTUAL-1";
        if (camera_.is_another()) serial[8] = '2';
        if (id != ONI_DEVICE_PROPERTY_SERIAL_NUMBER || *size < int(sizeof serial)) return ONI_STATUS_NOT_SUPPORTED;
        std::memcpy(data, serial, sizeof serial);
        *size = sizeof serial;
        return ONI_STATUS_OK;
    }
    OniBool isPropertySupported(int id) override {
        return id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION || id == ONI_DEVICE_PROPERTY_SERIAL_NUMBER;
    }
    // What a wait for frames calls first; so a hung one is a hung native read.
    OniStatus tryManualTrigger() override {
        camera_.enter(ON_READ);
        return ONI_STATUS_OK;
    }
    OniBool isImageRegistrationModeSupported(OniImageRegistrationMode mode) override {
        return mode == ONI_IMAGE_REGISTRATION_OFF ||
               (mode == ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR && camera_.block().can_register);
    }

    bool is_running(Stream kind) {
        std::lock_guard lock(mutex_);
        return streams_[kind] != nullptr && streams_[kind]->is_running();
    }
    VirtualStream* reserved(Stream kind) {
        std::lock_guard lock(mutex_);
        VirtualStream* stream = streams_[kind];
        return stream != nullptr && stream->reserve() ? stream : nullptr;
    }
    bool is_registered() const { return is_registered_; }
    void cut(bool is_cut) {
        std::lock_guard lock(mutex_);
        for (auto* stream : streams_) if (stream) stream->cut(is_cut);
    }

private:
    Camera& camera_;
    std::mutex mutex_;
    VirtualStream* streams_[2] = {nullptr, nullptr};
    std::atomic<bool> is_registered_ {false};
};

class VirtualDriver : public oni::driver::DriverBase {
public:
    explicit VirtualDriver(OniDriverServices* services) : DriverBase(services) {}

    OniStatus initialize(oni::driver::DeviceConnectedCallback connected, oni::driver::DeviceDisconnectedCallback gone,
                         oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
        DriverBase::initialize(connected, gone, changed, cookie);
        const char* path = std::getenv("VIRTUAL_XTION");
        if (path == nullptr || !map(path)) return ONI_STATUS_ERROR;
        name_anew(0);
        std::strncpy(info_.vendor, "Tidegate", ONI_MAX_STR - 1);
        std::strncpy(info_.name, "Virtual Xtion", ONI_MAX_STR - 1);
        info_.usbVendorId = 0x1d27;
        info_.usbProductId = 0x0601;
        if (camera_->is_plugged()) deviceConnected(&info_);
        if (camera_->is_owner()) thread_ = std::thread([this] { camera_->run(outlet()); });
        return ONI_STATUS_OK;
    }

    oni::driver::DeviceBase* deviceOpen(const char*, const char*) override {
        camera_->enter(ON_OPEN);
        // Like a real one, it is one process's at a time.
        if (!camera_->is_owner() || !camera_->is_plugged()) return nullptr;
        std::lock_guard lock(mutex_);
        camera_->block().status.is_open = 1;
        return device_ = new VirtualDevice(*camera_);
    }
    void deviceClose(oni::driver::DeviceBase* device) override {
        camera_->enter(ON_CLOSE);
        std::lock_guard lock(mutex_);
        if (device_ == device) {
            device_ = nullptr;
            camera_->block().status.is_open = 0;
            camera_->block().status.registration = 0;
        }
        delete device;
    }
    OniStatus tryDevice(const char*) override { return ONI_STATUS_ERROR; }
    void shutdown() override {
        if (camera_) camera_->end();
        if (thread_.joinable()) thread_.join();
    }

private:
    bool map(const char* path) {
        int fd = open(path, O_RDWR);
        if (fd < 0) return false;
        void* at = mmap(nullptr, sizeof(Block), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
        if (at == MAP_FAILED) return false;
        auto* block = static_cast<Block*>(at);
        if (block->magic != MAGIC || block->version != VERSION || block->size != int64_t(sizeof(Block))) return false;
        bool is_owner = flock(fd, LOCK_EX | LOCK_NB) == 0;   // until this process ends
        ring_ = new Ring(block->ring_path);
        if (!ring_->is_there()) return false;
        camera_ = new Camera(*block, is_owner, *ring_);
        darkroom_ = new Darkroom(*ring_);
        return true;
    }

    Outlet outlet() {
        Outlet outlet;
        outlet.deliver = [this](const Shot& shot) {
            VirtualStream* stream = nullptr;
            bool is_registered = false;
            {
                std::lock_guard lock(mutex_);
                if (device_ != nullptr) stream = device_->reserved(shot.stream);
                is_registered = device_ != nullptr && device_->is_registered();
            }
            // No lock of ours is held while the runtime is called.
            if (stream != nullptr) stream->raise_reserved(shot, *darkroom_, is_registered);
        };
        outlet.is_running = [this](Stream kind) {
            std::lock_guard lock(mutex_);
            return device_ != nullptr && device_->is_running(kind);
        };
        outlet.tell_plugged = [this](bool is_plugged) {
            if (!is_plugged) { deviceDisconnected(&info_); return; }
            name_anew(++plugs_);
            deviceConnected(&info_);
        };
        outlet.tell_state = [this](int64_t state) { deviceStateChanged(&info_, int(state)); };
        outlet.cut_open_streams = [this] { cut(true); };
        outlet.mend_open_streams = [this] { cut(false); };
        return outlet;
    }
    void cut(bool is_cut) {
        std::lock_guard lock(mutex_);
        if (device_) device_->cut(is_cut);
    }

    // A camera on a bus has another address each time it is plugged in.
    void name_anew(int plugs) {
        std::string uri = plugs ? std::string(URI) + "@" + std::to_string(plugs) : URI;
        std::memset(info_.uri, 0, ONI_MAX_STR);
        std::strncpy(info_.uri, uri.c_str(), ONI_MAX_STR - 1);
    }

    OniDeviceInfo info_ {};
    int plugs_ = 0;
    Ring* ring_ = nullptr;
    Camera* camera_ = nullptr;
    Darkroom* darkroom_ = nullptr;
    std::mutex mutex_;
    VirtualDevice* device_ = nullptr;
    std::thread thread_;
};

}  // namespace

ONI_EXPORT_DRIVER(VirtualDriver);
