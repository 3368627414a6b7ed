// Camera poses by Gauss-Newton on the SDF at back-projected surface points, the scene frozen.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/philox.h"
#include "spslam/scene_view.h"
#include "spslam/types/depth_noise.h"
#include "spslam/types/recent_motion.h"

namespace spslam {

// cost (m^2), inlier share, |translation step| (m), |rotation step| (rad), mean score weight over all pixels
constexpr int kTrackingStatSize = 5;
// Of tracking: these, and after the step the natural logarithm of the frame's gain and the variance of its steps.
constexpr int kFrameStatSize = kTrackingStatSize + 2;
constexpr int kHessianSize = 36;  // of a pose, by rows

// How a camera came to a frame: from the pose in a row of a table, in so many seconds; a negative row: unknown. And by
// how much later the frame's color was taken than its depth, s, as the stamps of the two say.
struct FrameMotion {
  std::int64_t row;
  float seconds, color_offset;
};

// A small gray image of an earlier frame, which tracking compares colors with; none where height is 0.
struct ReferenceImage {
  const float* cells;  // [height, width, 2] intensity in [0, 1], depth (m; 0 where unknown)
  const float* pose;   // [7] T_world_camera of the frame
  std::int64_t height, width;
  Intrinsics intrinsics;  // in cells
  float weight;           // m that an intensity difference of 1 counts as
  float kernel;           // width of the robust kernel, intensity
  // How the camera came to the frame, in rows of the depth keyframes' poses, and the logarithm [1] of the frame's gain:
  // read where the depth keyframes have a delay, or gains.
  FrameMotion motion;
  const float* log_gain;
};

// The noise of a pixel's depth, and the variance of the difference between its intensity and an earlier image's, where
// that has the gradient g (1/px): intensity_floor + intensity_growth g^2.
struct SensorNoise {
  DepthNoise depth;
  float intensity_floor, intensity_growth;  // of [0, 1], px^2
};
constexpr int kSensorNoiseSize = 4;

constexpr int kMaxDepthKeyframes = 8;

// Depth images of earlier frames, which tracking aligns surface points with; none where count is 0.
struct DepthKeyframes {
  const std::uint16_t* images;      // [R, height, width] depth in `unit`, 0 where unknown
  const std::uint8_t* intensities;  // [R, height, width] intensity in 1/255; may be null
  const float* poses;               // [F, 7] T_world_camera
  std::int64_t height, width;
  Intrinsics intrinsics;         // of the images
  float unit;                    // m
  float kernel_end;              // m, width of the robust kernel at the last iterations
  std::int64_t first_iteration;  // from which on they take part
  int count;
  std::int64_t image_rows[kMaxDepthKeyframes], pose_rows[kMaxDepthKeyframes];  // of each keyframe
  // s, from a frame's depth image to its color image, beside what stamps say; null: they are of one moment.
  const float* color_delay;
  // s, [R], by what readout each image was rectified; null: by that which is known. Read where that is measured.
  const float* readouts;
  FrameMotion motions[kMaxDepthKeyframes], frame_motion;  // of each keyframe, and of the frame that is aligned
  // Natural logarithms of gains, by how much brighter a frame's image is than others': of row f of the poses at f times
  // the stride, and [1] of the frame that is aligned, as far as it is known. Null: all are alike.
  const float *log_gains, *frame_log_gain;
  std::int64_t log_gain_stride;
  const float* gain_variance;  // [1] of the step from there to the frame's own gain; null: it may be any
};

// The scalars of GaussNewtonOptions, type and name, in the order of the fields of ops.GaussNewtonOptions: a line here
// and a field there are a new one, from Python down to the kernels.
#define SPS_GAUSS_NEWTON_SCALARS(FIELD)                                                      \
  FIELD(float, truncation)        /* m */                                                    \
  FIELD(float, kernel_start)      /* m, width of the robust kernel at the first iteration */ \
  FIELD(float, kernel_end)        /* m, at the last iterations */                            \
  FIELD(double, damping)          /* relative Levenberg damping */                           \
  FIELD(float, score_kernel)      /* m, of cost and mean weight; 0: the iteration's own */   \
  FIELD(double, held_information) /* per weight: directions of less move little before depth keyframes take part */
#define SPS_DECLARE_FIELD(type, name) type name;

struct GaussNewtonOptions {
  Intrinsics intrinsics;
  std::int64_t num_pixels, iterations;
  SPS_GAUSS_NEWTON_SCALARS(SPS_DECLARE_FIELD)
  PhiloxKey key;       // its iteration is replaced by the running one
  bool tf32;           // on CUDA devices that have it: factors of products in the decoder keep 10 bits of mantissa
  const float* noise;  // [kSensorNoiseSize], the fields of SensorNoise; null weighs all depths alike, no intensities
  ReferenceImage reference;
  DepthKeyframes depth_keyframes;
  const float* wanted;  // [1], on the device: nothing is done unless it is 1; null: it is
};
#undef SPS_DECLARE_FIELD

// next [7]: the pose at constant speed, (T1 T0^-1)^steps T1.
template <class Device>
void predict_pose(Device device, const RecentMotion& motion, float* next);

// Bytes of scratch for the launches below.
template <class Device>
std::int64_t gauss_newton_workspace_size(Device device, std::int64_t frames, std::int64_t pixels);

// One frame. pixels [num_records, 3] are drawn from anew in each iteration; pose [7] is read and overwritten; stats
// [iterations, kFrameStatSize]; hessian [36] of the last iteration, before damping.
template <class Device>
void track_gauss_newton(Device device, const SceneView& scene, const std::int32_t* pixels, std::int64_t num_records,
                        const GaussNewtonOptions& options, void* workspace, float* pose, float* stats, float* hessian);

// Normal equations of F frames' poses.
struct PoseEquations {
  float* hessian;   // [F, 36]
  float* gradient;  // [F, 6]
  float* cost;      // [F] weighted mean squared residual, m^2
  float* inliers;   // [F] share of the pixels
};

// Of F frames with N pixels each: pixels [F, N, 3], poses [F, 7]; kernel is the width of the robust kernel, m.
template <class Device>
void gauss_newton_poses(Device device, const SceneView& scene, const std::int32_t* pixels, const float* poses,
                        std::int64_t frames, std::int64_t pixels_per_frame, const Intrinsics& intrinsics,
                        float truncation, float kernel, void* workspace, const PoseEquations& out);

}  // namespace spslam
