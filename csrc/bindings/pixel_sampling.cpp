#include "spslam/pixel_sampling.h"

#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

Tensor rows_of_three(const Tensor& like) {
  return empty(like, {like.size(0), 3}, ScalarType::Float);
}

std::tuple<Tensor, Tensor> unproject_pixels(Tensor records, Tensor normals, Tensor pose, double fx, double fy,
                                            double cx, double cy) {
  SPS_CHECK(has_shape(records, {-1, 3}) && same_shape(normals, records) && has_shape(pose, {7}),
            "unproject_pixels: records, normals and pose must have shapes [P, 3], [P, 3] and [7]");
  records = as_contiguous(records);
  normals = as_contiguous(normals);
  pose = as_contiguous(pose);
  DeviceScope scope(records);
  const Tensor points = rows_of_three(records), world_normals = rows_of_three(records);
  spslam::unproject_pixels(
      scope.context, data<std::int32_t>(records), data<float>(normals), records.size(0), data<float>(pose),
      {static_cast<float>(fx), static_cast<float>(fy), static_cast<float>(cx), static_cast<float>(cy)},
      mutable_data<float>(points), mutable_data<float>(world_normals));
  return {points, world_normals};
}

// Places in the lists of numbers of sample_frame_pixels; spslam/ops/pixel_sampling.py fills them.
enum class Scalar { kFx, kFy, kCx, kCy, kMinDepth, kMaxDepth, kMaxJump, kDepthImageUnit, kCount };
enum class Integer { kNumPixels, kStepPx, kThumbnailStep, kDepthImageStep, kShared, kSeed, kStream, kFrame, kCount };

PixelSampling load_sampling(const Scalars<Scalar>& scalars, const Integers<Integer>& integers) {
  constexpr std::int64_t kMaxSide = 65535;  // a record has 16 bits per coordinate
  const auto in_range = [&](Integer place, std::int64_t least, std::int64_t most) {
    return integers[place] >= least && integers[place] <= most;
  };
  SPS_CHECK(in_range(Integer::kNumPixels, 0, std::int64_t{1} << 30) && in_range(Integer::kStepPx, 1, kMaxSide) &&
                in_range(Integer::kThumbnailStep, 1, kMaxSide) && in_range(Integer::kDepthImageStep, 0, kMaxSide),
            "sample_frame_pixels: count, step_px, thumbnail_step, depth_image_step must be at least 0, 1, 1, 0");
  SPS_CHECK(integers[Integer::kDepthImageStep] == 0 || scalars[Scalar::kDepthImageUnit] > 0.0,
            "sample_frame_pixels: depth_image_unit must be positive");
  return {integers[Integer::kNumPixels],
          scalars.as<float>(Scalar::kMinDepth),
          scalars.as<float>(Scalar::kMaxDepth),
          integers.as<std::int32_t>(Integer::kStepPx),
          scalars.as<float>(Scalar::kMaxJump),
          integers.as<std::int32_t>(Integer::kThumbnailStep),
          integers.as<std::int32_t>(Integer::kDepthImageStep),
          scalars.as<float>(Scalar::kDepthImageUnit),
          integers.as<bool>(Integer::kShared)};
}

// Words that hold `count` numbers, of which `per_word` fit in one.
std::int64_t words_of(std::int64_t count, std::int64_t per_word) {
  return (count + per_word - 1) / per_word;
}

// One buffer for all: records [count, 3], normals [count, 3] as their bits, the depth thumbnail's halves in pairs, the
// depth image's 16-bit numbers in pairs, the intensity image's bytes by fours.
std::tuple<Tensor, std::int64_t> sample_frame_pixels(Tensor depth, Tensor color, std::vector<double> scalar_list,
                                                     std::vector<std::int64_t> integer_list) {
  const Scalars<Scalar> scalars("sample_frame_pixels", "scalars", scalar_list);
  const Integers<Integer> integers("sample_frame_pixels", "integers", integer_list);
  const PixelSampling sampling = load_sampling(scalars, integers);
  SPS_CHECK(depth.dim() == 2 && depth.size(0) <= 65535 && depth.size(1) <= 65535 &&
                depth.numel() < (std::int64_t{1} << 31) && has_shape(color, {depth.size(0), depth.size(1), 3}),
            "sample_frame_pixels: depth and color must have shapes [H, W] and [H, W, 3], H and W below 2^16");
  depth = as_contiguous(depth);
  color = as_contiguous(color);
  const std::int32_t height = static_cast<std::int32_t>(depth.size(0)),
                     width = static_cast<std::int32_t>(depth.size(1));
  const RgbdImage image{
      data<float>(depth),   data<std::uint8_t>(color), width, height, scalars[Scalar::kFx], scalars[Scalar::kFy],
      scalars[Scalar::kCx], scalars[Scalar::kCy]};
  const std::int64_t thumbnail = static_cast<std::int64_t>(thumbnail_size(height, sampling.thumbnail_step)) *
                                 thumbnail_size(width, sampling.thumbnail_step);
  const std::int64_t depth_image = static_cast<std::int64_t>(depth_image_size(height, sampling.depth_image_step)) *
                                   depth_image_size(width, sampling.depth_image_step);
  const std::int64_t thumbnail_at = 6 * sampling.count, depth_image_at = thumbnail_at + words_of(thumbnail, 2);
  const std::int64_t intensity_at = depth_image_at + words_of(depth_image, 2);
  Tensor buffer = empty(depth, {intensity_at + words_of(depth_image, 4)}, ScalarType::Int);
  DeviceScope scope(depth);
  const auto blank_before = [&](std::int64_t end) {
    torch::stable::fill_(torch::stable::narrow(buffer, 0, end - 1, 1), 0);
  };
  if (thumbnail % 2 != 0) blank_before(depth_image_at);
  if (depth_image % 2 != 0) blank_before(intensity_at);
  if (depth_image % 4 != 0) blank_before(buffer.numel());
  const Tensor workspace =
      empty(depth, {sample_pixels_workspace_bytes(scope.context, width, height)}, ScalarType::Byte);
  std::int32_t* words = mutable_data<std::int32_t>(buffer);
  const SampledPixels out{words, reinterpret_cast<float*>(words + 3 * sampling.count),
                          reinterpret_cast<std::uint16_t*>(words + thumbnail_at),
                          reinterpret_cast<std::uint16_t*>(words + depth_image_at),
                          reinterpret_cast<std::uint8_t*>(words + intensity_at)};
  return {buffer, sample_pixels(scope.context, image, load_key(integers, 0), sampling,
                                mutable_data<std::uint8_t>(workspace), out)};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "unproject_pixels(Tensor records, Tensor normals, Tensor pose, float fx, float fy, float cx, float cy) -> "
      "(Tensor points, Tensor normals)");
  m.def(
      "sample_frame_pixels(Tensor depth, Tensor color, float[] scalars, int[] integers) -> (Tensor buffer, int "
      "num_valid)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("unproject_pixels", TORCH_BOX(&unproject_pixels));
  m.impl("sample_frame_pixels", TORCH_BOX(&sample_frame_pixels));
}

}  // namespace spslam::bindings
