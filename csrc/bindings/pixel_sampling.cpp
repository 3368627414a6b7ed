#include "spslam/pixel_sampling.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

Tensor rows_of_three(const Tensor& like) {
  return empty(like, {like.size(0), 3}, ScalarType::Float);
}

std::tuple<Tensor, Tensor> unproject_pixels(Tensor records, Tensor normals, Tensor pose, double fx, double fy,
                                            double cx, double cy) {
  SPS_CHECK(has_shape(records, {-1, 3}) && same_shape(normals, records) && has_shape(pose, {7}),
            "unproject_pixels: records, normals and pose must have shapes [P, 3], [P, 3] and [7]");
  records = contiguous(records);
  normals = contiguous(normals);
  pose = contiguous(pose);
  DeviceScope scope(records);
  const Tensor points = rows_of_three(records), world_normals = rows_of_three(records);
  spslam::unproject_pixels(
      scope.context, data<std::int32_t>(records), data<float>(normals), records.size(0), data<float>(pose),
      {static_cast<float>(fx), static_cast<float>(fy), static_cast<float>(cx), static_cast<float>(cy)},
      mutable_data<float>(points), mutable_data<float>(world_normals));
  return {points, world_normals};
}

#ifndef SPS_CUDA
// Frames arrive on the CPU, so this op is there alone. One buffer for all: records [count, 3], normals [count, 3] as
// their bits, the depth thumbnail's halves in pairs, the view's 16-bit numbers in pairs.
std::tuple<Tensor, std::int64_t> sample_frame_pixels(Tensor depth, Tensor color, double fx, double fy, double cx,
                                                     double cy, std::int64_t count, double min_depth, double max_depth,
                                                     std::int64_t step_px, double max_jump, std::int64_t thumbnail_step,
                                                     std::int64_t depth_image_step, double depth_image_unit,
                                                     std::int64_t seed, std::int64_t stream, std::int64_t frame) {
  constexpr std::int64_t kMaxSide = 65535;  // a record has 16 bits a coordinate
  SPS_CHECK(depth.dim() == 2 && depth.size(0) <= kMaxSide && depth.size(1) <= kMaxSide &&
                depth.numel() < (std::int64_t{1} << 31) && has_shape(color, {depth.size(0), depth.size(1), 3}),
            "sample_frame_pixels: depth and color must have shapes [H, W] and [H, W, 3], H and W below 2^16");
  SPS_CHECK(count >= 0 && count <= (std::int64_t{1} << 30) && step_px >= 1 && step_px <= kMaxSide &&
                thumbnail_step >= 1 && thumbnail_step <= kMaxSide && depth_image_step >= 0 &&
                depth_image_step <= kMaxSide && (depth_image_step == 0 || depth_image_unit > 0.0),
            "sample_frame_pixels: count, step_px, thumbnail_step, depth_image_step must be at least 0, 1, 1, 0, "
            "depth_image_unit positive");
  depth = contiguous(depth);
  color = contiguous(color);
  const std::int32_t height = static_cast<std::int32_t>(depth.size(0)),
                     width = static_cast<std::int32_t>(depth.size(1));
  const RgbdImage image{data<float>(depth), data<std::uint8_t>(color), width, height, fx, fy, cx, cy};
  const PixelSampling sampling{count,
                               static_cast<float>(min_depth),
                               static_cast<float>(max_depth),
                               static_cast<std::int32_t>(step_px),
                               static_cast<float>(max_jump),
                               static_cast<std::int32_t>(thumbnail_step),
                               static_cast<std::int32_t>(depth_image_step),
                               static_cast<float>(depth_image_unit)};
  const std::int64_t depth_thumbnail = static_cast<std::int64_t>(thumbnail_size(height, sampling.thumbnail_step)) *
                                       thumbnail_size(width, sampling.thumbnail_step);
  const std::int64_t view = static_cast<std::int64_t>(depth_image_size(height, sampling.depth_image_step)) *
                            depth_image_size(width, sampling.depth_image_step);
  const std::int64_t thumbnail_at = 6 * count, view_at = thumbnail_at + (depth_thumbnail + 1) / 2;
  const Tensor buffer = empty(depth, {view_at + (view + 1) / 2}, ScalarType::Int);
  std::int32_t* words = mutable_data<std::int32_t>(buffer);
  if (depth_thumbnail % 2 != 0) words[view_at - 1] = 0;
  if (view % 2 != 0) words[buffer.numel() - 1] = 0;
  const SampledPixels out{words, reinterpret_cast<float*>(words + 3 * count),
                          reinterpret_cast<std::uint16_t*>(words + thumbnail_at),
                          reinterpret_cast<std::uint16_t*>(words + view_at)};
  return {buffer, sample_pixels(image, philox_key(seed, stream, frame, 0), sampling, out)};
}

#endif

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "unproject_pixels(Tensor records, Tensor normals, Tensor pose, float fx, float fy, float cx, float cy) -> "
      "(Tensor points, Tensor normals)");
  m.def(
      "sample_frame_pixels(Tensor depth, Tensor color, float fx, float fy, float cx, float cy, int count, float "
      "min_depth, float max_depth, int step_px, float max_jump, int thumbnail_step, int depth_image_step, float "
      "depth_image_unit, int "
      "seed, int stream, int frame) -> "
      "(Tensor buffer, int num_valid)");
}

STABLE_TORCH_LIBRARY_IMPL(spslam, CPU, m) {
  m.impl("sample_frame_pixels", TORCH_BOX(&sample_frame_pixels));
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("unproject_pixels", TORCH_BOX(&unproject_pixels));
}

}  // namespace spslam::bindings
