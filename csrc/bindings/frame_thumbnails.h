// The argument of ops that compare frames by their poses and depth thumbnails.
#pragma once

#include "bindings/common.h"
#include "spslam/covisibility.h"

namespace spslam::bindings {

// Keeps the tensors alive while a kernel reads the frames.
class FramesArgument {
 public:
  FramesArgument(const char* function, const Tensor& poses, const Tensor& depth_thumbnails,
                 const std::vector<double>& intrinsics, std::int64_t step)
      : poses_(as_contiguous(poses)), thumbnails_(as_contiguous(depth_thumbnails)) {
    SPS_CHECK(poses.dim() == 2 && poses.size(1) == kPoseSize, function, ": poses must have shape [F, 7]");
    SPS_CHECK(depth_thumbnails.dim() == 3 && depth_thumbnails.size(0) == poses.size(0) &&
                  depth_thumbnails.scalar_type() == ScalarType::Half,
              function, ": depth_thumbnails must be float16 of shape [F, h, w]");
    SPS_CHECK(step >= 1, function, ": thumbnail_step must be >= 1");
    frames = {data<float>(poses_),
              static_cast<const std::uint16_t*>(thumbnails_.const_data_ptr()),
              poses.size(0),
              depth_thumbnails.size(1),
              depth_thumbnails.size(2),
              load_intrinsics(function, intrinsics),
              step};
  }

  FrameThumbnails frames;

 private:
  Tensor poses_, thumbnails_;
};

}  // namespace spslam::bindings
