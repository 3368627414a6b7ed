// Depth keyframes as arguments of ops.
#pragma once

#include <algorithm>

#include "bindings/number_list.h"
#include "spslam/gauss_newton.h"

namespace spslam::bindings {

#define SPS_DEPTH_KEYFRAMES_SCHEMA \
  "Tensor[] depth_keyframes, float[] depth_keyframe_scalars, int[] depth_keyframe_integers"

// Places in the lists of numbers; spslam/ops/earlier_frames.py fills them.
enum class KeyframeScalar { kFx, kFy, kCx, kCy, kUnit, kKernelEnd, kCount };
// Before the places of each depth keyframe. Times are in ns; a motion's row is negative where it is unknown.
enum class KeyframeInteger { kFirstIteration, kMotionRow, kMotionNs, kColorNs, kCount };
enum class KeyframePlace { kImage, kPose, kMotionRow, kMotionNs, kColorNs, kCount };

// A motion's row and times.
inline FrameMotion load_motion(const char* name, const std::int64_t* integers, std::int64_t poses) {
  if (integers[0] < 0) return {-1, 1.0f, 0.0f};
  SPS_CHECK(integers[0] < poses && integers[1] > 0, name,
            ": timing must name poses that are there and positive times, got ", integers[0], " and ", integers[1],
            " ns");
  return {integers[0], 1e-9f * static_cast<float>(integers[1]), 1e-9f * static_cast<float>(integers[2])};
}

// Whether there are log gains among the tensors below: of all frames, the last but one, and of the one compared.
inline bool has_log_gains(const std::vector<Tensor>& tensors) {
  return tensors.size() >= 5 && tensors[tensors.size() - 2].dim() == 2;
}

// The tensors below, contiguous; the log gains of all frames may stay a column of a table, which has a stride.
inline std::vector<Tensor> readable_keyframes(const std::vector<Tensor>& tensors) {
  std::vector<Tensor> result = tensors;
  for (std::size_t i = 0; i < result.size(); ++i) {
    const bool is_column = has_log_gains(tensors) && i + 2 == tensors.size() && tensors[i].dim() == 2;
    if (!is_column) result[i] = as_contiguous(tensors[i]);
  }
  return result;
}

// Of the images, the poses and, if any, the intensities, and after them, if any, the delay of colors and the readouts,
// and the log gains of all frames and of the one compared, there perhaps with a variance; none without tensors. They
// must outlive the launch.
inline DepthKeyframes load_depth_keyframes(const char* name, const std::vector<Tensor>& tensors,
                                           const std::vector<double>& numbers,
                                           const std::vector<std::int64_t>& integers) {
  if (tensors.empty()) return {};
  const Scalars<KeyframeScalar> scalars(name, "depth_keyframe_scalars", numbers);
  SPS_CHECK(tensors.size() >= 2 && tensors.size() <= 7 && tensors[0].dim() == 3 && tensors[1].dim() == 2 &&
                tensors[1].size(1) == kPoseSize && (tensors.size() == 2 || same_shape(tensors[2], tensors[0])),
            name, ": depth_keyframes must be images [R, H, W], poses [F, 7] and, if any, intensities [R, H, W]");
  const std::size_t size = tensors.size();
  const bool has_gains = has_log_gains(tensors);
  const std::size_t times = size - (has_gains ? 2 : 0) - std::min<std::size_t>(size, 3);
  const bool has_delay = times >= 1, has_readouts = times == 2;
  SPS_CHECK(times <= 2 && (!has_delay || tensors[3].numel() == 1), name, ": color_delay must have one element");
  SPS_CHECK(!has_readouts || has_shape(tensors[4], {tensors[0].size(0)}), name, ": readouts must have shape [R]");
  const std::int64_t own = has_gains ? tensors[size - 1].numel() : 0;
  SPS_CHECK(!has_gains || (has_shape(tensors[size - 2], {tensors[1].size(0), 1}) && (own == 1 || own == 2) &&
                           tensors[size - 1].is_contiguous()),
            name, ": log_gains must be those of the poses' frames and of one more");
  SPS_CHECK(scalars[KeyframeScalar::kUnit] > 0.0 && scalars[KeyframeScalar::kKernelEnd] > 0.0, name,
            ": depth_keyframes must have a positive unit and kernel_end");
  constexpr std::size_t kFirst = static_cast<std::size_t>(KeyframeInteger::kCount),
                        kEach = static_cast<std::size_t>(KeyframePlace::kCount);
  SPS_CHECK(integers.size() >= kFirst && (integers.size() - kFirst) % kEach == 0 &&
                integers.size() <= kFirst + kEach * kMaxDepthKeyframes,
            name, ": depth_keyframes must be at most ", kMaxDepthKeyframes);
  DepthKeyframes keyframes{};
  keyframes.images = data<std::uint16_t>(tensors[0]);
  keyframes.intensities = tensors.size() > 2 ? data<std::uint8_t>(tensors[2]) : nullptr;
  keyframes.color_delay = has_delay ? data<float>(tensors[3]) : nullptr;
  keyframes.readouts = has_readouts ? data<float>(tensors[4]) : nullptr;
  keyframes.log_gains = has_gains ? data<float>(tensors[size - 2]) : nullptr;
  keyframes.frame_log_gain = has_gains ? data<float>(tensors[size - 1]) : nullptr;
  keyframes.log_gain_stride = has_gains ? tensors[size - 2].stride(0) : 0;
  keyframes.gain_variance = own == 2 ? keyframes.frame_log_gain + 1 : nullptr;
  keyframes.poses = data<float>(tensors[1]);
  keyframes.height = tensors[0].size(1);
  keyframes.width = tensors[0].size(2);
  keyframes.intrinsics = load_intrinsics(scalars);
  keyframes.unit = scalars.as<float>(KeyframeScalar::kUnit);
  keyframes.kernel_end = scalars.as<float>(KeyframeScalar::kKernelEnd);
  keyframes.first_iteration = integers[static_cast<std::size_t>(KeyframeInteger::kFirstIteration)];
  const std::int64_t poses = tensors[1].size(0);
  keyframes.frame_motion = load_motion(name, &integers[static_cast<std::size_t>(KeyframeInteger::kMotionRow)], poses);
  keyframes.count = static_cast<int>((integers.size() - kFirst) / kEach);
  for (int k = 0; k < keyframes.count; ++k) {
    const std::int64_t* of = &integers[kFirst + kEach * k];
    const std::int64_t image = of[static_cast<int>(KeyframePlace::kImage)];
    const std::int64_t pose = of[static_cast<int>(KeyframePlace::kPose)];
    SPS_CHECK(image >= 0 && image < tensors[0].size(0) && pose >= 0 && pose < poses, name,
              ": depth_keyframes must name images and poses that are there, got ", image, " and ", pose);
    keyframes.image_rows[k] = image;
    keyframes.pose_rows[k] = pose;
    keyframes.motions[k] = load_motion(name, of + static_cast<int>(KeyframePlace::kMotionRow), poses);
  }
  return keyframes;
}

}  // namespace spslam::bindings
