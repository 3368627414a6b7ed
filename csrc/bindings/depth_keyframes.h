// Depth keyframes as arguments of ops.
#pragma once

#include "bindings/number_list.h"
#include "spslam/gauss_newton.h"

namespace spslam::bindings {

#define SPS_DEPTH_KEYFRAMES_SCHEMA \
  "Tensor[] depth_keyframes, float[] depth_keyframe_scalars, int[] depth_keyframe_integers"

// Places in the lists of numbers; spslam/ops/earlier_frames.py fills them.
enum class KeyframeScalar { kFx, kFy, kCx, kCy, kUnit, kKernelEnd, kCount };
// Before the rows of each depth keyframe's image and pose.
enum class KeyframeInteger { kFirstIteration, kCount };

inline std::vector<Tensor> all_contiguous(const std::vector<Tensor>& tensors) {
  std::vector<Tensor> result;
  for (const Tensor& tensor : tensors) result.push_back(contiguous(tensor));
  return result;
}

// Of the images, the poses and the intensities, if any; none without tensors. They must outlive the launch.
inline DepthKeyframes load_depth_keyframes(const char* name, const std::vector<Tensor>& tensors,
                                           const std::vector<double>& numbers,
                                           const std::vector<std::int64_t>& integers) {
  if (tensors.empty()) return {};
  const Scalars<KeyframeScalar> scalars(name, "depth_keyframe_scalars", numbers);
  SPS_CHECK((tensors.size() == 2 || tensors.size() == 3) && tensors[0].dim() == 3 && tensors[1].dim() == 2 &&
                tensors[1].size(1) == kPoseSize && (tensors.size() == 2 || same_shape(tensors[2], tensors[0])),
            name, ": depth_keyframes must be images [R, H, W], poses [F, 7] and, if any, intensities [R, H, W]");
  SPS_CHECK(scalars[KeyframeScalar::kUnit] > 0.0 && scalars[KeyframeScalar::kKernelEnd] > 0.0, name,
            ": depth_keyframes must have a positive unit and kernel_end");
  constexpr std::size_t kFirstRow = static_cast<std::size_t>(KeyframeInteger::kCount);
  SPS_CHECK(integers.size() % 2 == kFirstRow % 2 && integers.size() >= kFirstRow &&
                integers.size() <= kFirstRow + 2 * kMaxDepthKeyframes,
            name, ": depth_keyframes must be at most ", kMaxDepthKeyframes);
  DepthKeyframes keyframes{};
  keyframes.images = data<std::uint16_t>(tensors[0]);
  keyframes.intensities = tensors.size() == 3 ? data<std::uint8_t>(tensors[2]) : nullptr;
  keyframes.poses = data<float>(tensors[1]);
  keyframes.height = tensors[0].size(1);
  keyframes.width = tensors[0].size(2);
  keyframes.intrinsics = load_intrinsics(scalars);
  keyframes.unit = scalars.as<float>(KeyframeScalar::kUnit);
  keyframes.kernel_end = scalars.as<float>(KeyframeScalar::kKernelEnd);
  keyframes.first_iteration = integers[static_cast<std::size_t>(KeyframeInteger::kFirstIteration)];
  keyframes.count = static_cast<int>((integers.size() - kFirstRow) / 2);
  for (int k = 0; k < keyframes.count; ++k) {
    const std::int64_t image = integers[kFirstRow + 2 * k], pose = integers[kFirstRow + 2 * k + 1];
    SPS_CHECK(image >= 0 && image < tensors[0].size(0) && pose >= 0 && pose < tensors[1].size(0), name,
              ": depth_keyframes must name images and poses that are there, got ", image, " and ", pose);
    keyframes.image_rows[k] = image;
    keyframes.pose_rows[k] = pose;
  }
  return keyframes;
}

}  // namespace spslam::bindings
