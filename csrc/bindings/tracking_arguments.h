// What tracking by Gauss-Newton takes, as arguments of ops.
#pragma once

#include "bindings/depth_keyframes.h"
#include "bindings/scene.h"
#include "spslam/gauss_newton.h"

namespace spslam::bindings {

#define SPS_TRACKING_SCHEMA                                                         \
  SPS_SCENE_SCHEMA                                                                  \
  ", Tensor[] frame, float[] scalars, int[] integers, Tensor[] reference, float[] " \
  "reference_scalars, " SPS_DEPTH_KEYFRAMES_SCHEMA

// Places in the lists of numbers; spslam/ops/gauss_newton.py fills them.
#define SPS_NAME_PLACE(type, name) name,
enum class TrackingScalar { kFx, kFy, kCx, kCy, SPS_GAUSS_NEWTON_SCALARS(SPS_NAME_PLACE) kCount };
#undef SPS_NAME_PLACE
enum class TrackingInteger { kNumPixels, kIterations, kSeed, kStream, kFrame, kTf32, kCount };
enum class ReferenceScalar { kFx, kFy, kCx, kCy, kWeight, kKernel, kMotionRow, kMotionSeconds, kColorOffset, kCount };

// Of the cells, the pose and, if known, the log gain; none without tensors. They must outlive the launch.
inline ReferenceImage load_reference(const char* name, const std::vector<Tensor>& tensors,
                                     const std::vector<double>& numbers, std::int64_t poses) {
  if (tensors.empty()) return {};
  const Scalars<ReferenceScalar> scalars(name, "reference_scalars", numbers);
  SPS_CHECK((tensors.size() == 2 || (tensors.size() == 3 && tensors[2].numel() == 1)) && tensors[0].dim() == 3 &&
                tensors[0].size(2) == 2 && tensors[1].numel() == kPoseSize,
            name, ": reference must be cells [H, W, 2], a pose [7] and, if any, a log gain [1]");
  const double row = scalars[ReferenceScalar::kMotionRow], seconds = scalars[ReferenceScalar::kMotionSeconds];
  SPS_CHECK(row < 0.0 || poses == 0 || (row < static_cast<double>(poses) && seconds > 0.0), name,
            ": reference must name a pose that is there and a positive time, got ", row, " and ", seconds, " s");
  return {data<float>(tensors[0]),
          data<float>(tensors[1]),
          tensors[0].size(0),
          tensors[0].size(1),
          load_intrinsics(scalars),
          scalars.as<float>(ReferenceScalar::kWeight),
          scalars.as<float>(ReferenceScalar::kKernel),
          {row < 0.0 ? -1 : static_cast<std::int64_t>(row), static_cast<float>(seconds),
           scalars.as<float>(ReferenceScalar::kColorOffset)},
          tensors.size() == 3 ? data<float>(tensors[2]) : nullptr};
}

inline GaussNewtonOptions load_tracking_options(const char* name, const std::vector<double>& numbers,
                                                const std::vector<std::int64_t>& whole_numbers) {
  const Scalars<TrackingScalar> scalars(name, "scalars", numbers);
  const Integers<TrackingInteger> integers(name, "integers", whole_numbers);
  GaussNewtonOptions options{};
  options.intrinsics = load_intrinsics(scalars);
  options.num_pixels = integers[TrackingInteger::kNumPixels];
  options.iterations = integers[TrackingInteger::kIterations];
#define SPS_LOAD_FIELD(type, name) options.name = scalars.as<type>(TrackingScalar::name);
  SPS_GAUSS_NEWTON_SCALARS(SPS_LOAD_FIELD)
#undef SPS_LOAD_FIELD
  options.key = load_key(integers, 0);
  options.tf32 = integers.as<bool>(TrackingInteger::kTf32);
  check_count(name, "num_pixels", options.num_pixels);
  check_count(name, "iterations", options.iterations);
  return options;
}

// The lists of the schema, but for the frame.
struct TrackingLists {
  std::vector<Tensor> scene;
  std::vector<double> scene_scalars;
  std::vector<std::int64_t> plane_layout;
  std::vector<double> scalars;
  std::vector<std::int64_t> integers;
  std::vector<Tensor> reference;
  std::vector<double> reference_scalars;
  std::vector<Tensor> depth_keyframes;
  std::vector<double> depth_keyframe_scalars;
  std::vector<std::int64_t> depth_keyframe_integers;
};

// The scene and the options of a call; keeps the tensors alive while kernels read them.
class TrackingArguments {
 public:
  // `noise` is contiguous; null weighs all depths alike.
  TrackingArguments(const char* name, const TrackingLists& lists, const Tensor* noise)
      : options(load_tracking_options(name, lists.scalars, lists.integers)),
        scene_(lists.scene, lists.scene_scalars, lists.plane_layout),
        reference_(all_contiguous(lists.reference)),
        depth_keyframes_(readable_keyframes(lists.depth_keyframes)) {
    SPS_CHECK(!noise || noise->numel() == kSensorNoiseSize, name, ": noise must have ", kSensorNoiseSize, " elements");
    options.noise = noise ? data<float>(*noise) : nullptr;
    const std::int64_t poses = depth_keyframes_.empty() ? 0 : depth_keyframes_[1].size(0);
    options.reference = load_reference(name, reference_, lists.reference_scalars, poses);
    options.depth_keyframes =
        load_depth_keyframes(name, depth_keyframes_, lists.depth_keyframe_scalars, lists.depth_keyframe_integers);
  }

  const SceneView& scene() const { return scene_.view; }

  GaussNewtonOptions options;

 private:
  SceneArgument scene_;
  std::vector<Tensor> reference_, depth_keyframes_;
};

}  // namespace spslam::bindings
