// Frames of a rolling shutter as a camera would have them that takes all rows at the middle row's moment.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/types/camera.h"
#include "spslam/types/recent_motion.h"

namespace spslam {

// How the camera moves while it reads a frame out: `before` [7] is the pose of the frame `seconds` earlier, `pose` [7]
// that of the frame's middle row, readout [1] (s) the time from its first row to its last.
struct ShutterMotion {
  const float *before, *pose, *readout;
  float seconds;
};

// The camera of a frame's images.
struct ShutterCamera {
  Intrinsics intrinsics;
  std::int64_t height, width;
};

// records [num_records, 3] to out, which may be the same. `wanted` [1], on the device: nothing is done unless it is 1;
// null: it is.
template <class Device>
void rectify_shutter_records(Device device, const std::int32_t* records, std::int64_t num_records,
                             const ShutterMotion& motion, const ShutterCamera& camera, std::int32_t* out,
                             const float* wanted = nullptr);

// Depth (in `unit` m, 0 where unknown) and intensity, both [height, width] of the camera.
struct FrameImages {
  const std::uint16_t* depth;
  const std::uint8_t* intensity;
  float unit;
};

template <class Device>
void rectify_shutter_images(Device device, const FrameImages& images, const ShutterMotion& motion,
                            const ShutterCamera& camera, std::uint16_t* depth, std::uint8_t* intensity);

// Where a rectified frame is written to.
struct ShutterFrame {
  std::int32_t* records;
  std::uint16_t* depth;
  std::uint8_t* intensity;
};

// Records and images of a frame in one go, to other memory.
template <class Device>
void rectify_shutter_frame(Device device, const std::int32_t* records, std::int64_t num_records,
                           const FrameImages& images, const ShutterMotion& motion, const ShutterCamera& camera,
                           const ShutterCamera& image_camera, const ShutterFrame& out);

// Image features of a frame: positions [count, 2] (px) and surface points [count, 3] in camera axes (m), 0 where the
// depth is unknown and they turn only. `camera` is that of the image. On the host; out may be the same memory.
void rectify_shutter_features(Cpu device, const float* positions, const float* points, std::int64_t count,
                              const ShutterMotion& motion, const ShutterCamera& camera, float* out_positions,
                              float* out_points);

// What is predicted of a frame: its pose [7], the readout [1] that counts for it, and its records as they are
// rectified.
struct PredictedFrame {
  float *pose, *readout;
  std::int32_t* records;
};

// predict_pose, and the records of a frame `seconds` after the last pose as the motion from there to the predicted pose
// rectifies them.
template <class Device>
void predict_frame(Device device, const RecentMotion& motion, const float* readout, float seconds,
                   const std::int32_t* records, std::int64_t num_records, const ShutterCamera& camera,
                   const PredictedFrame& out);

}  // namespace spslam
