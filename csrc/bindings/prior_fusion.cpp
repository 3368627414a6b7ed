#include "spslam/prior_fusion.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

void fuse_prior_(Tensor embeddings, Tensor weights, Tensor voxel_ids, Tensor features, Tensor feature_weights,
                 double max_weight) {
  voxel_ids = contiguous(voxel_ids);
  features = contiguous(features);
  feature_weights = contiguous(feature_weights);
  const std::int64_t count = voxel_ids.numel();
  STD_TORCH_CHECK(features.numel() == 8 * count && feature_weights.numel() == count && embeddings.dim() == 2 &&
                      embeddings.size(1) == 8 && weights.numel() == embeddings.size(0),
                  "fuse_prior_: embeddings and features must have 8 channels and a row a weight");
  DeviceScope scope(embeddings);
  fuse_prior(scope.context, data<std::int32_t>(voxel_ids), data<float>(features), data<float>(feature_weights), count,
             embeddings.size(0), static_cast<float>(max_weight), mutable_data<float>(embeddings),
             mutable_data<float>(weights));
}

Tensor depth_normals(Tensor depth, Tensor pixels, double fx, double fy, double cx, double cy, std::int64_t step_px,
                     double max_jump) {
  depth = contiguous(depth);
  pixels = contiguous(pixels);
  DeviceScope scope(depth);
  const DepthImage image{
      data<float>(depth),
      static_cast<std::int32_t>(depth.size(1)),
      static_cast<std::int32_t>(depth.size(0)),
      {static_cast<float>(fx), static_cast<float>(fy), static_cast<float>(cx), static_cast<float>(cy)}};
  const Tensor normals = empty(depth, {pixels.size(0), 3}, ScalarType::Float);
  spslam::depth_normals(scope.context, image, data<std::int32_t>(pixels), pixels.size(0),
                        static_cast<std::int32_t>(step_px), static_cast<float>(max_jump), mutable_data<float>(normals));
  return normals;
}

std::tuple<Tensor, Tensor, Tensor> encode_points(Tensor points, Tensor normals, Tensor encoder_params,
                                                 double voxel_size, std::int64_t neighborhood, double min_pair_weight) {
  STD_TORCH_CHECK(encoder_params.numel() == kEncoderParameters, "encode_points: encoder_params must have ",
                  kEncoderParameters, " numbers, got ", encoder_params.numel());
  STD_TORCH_CHECK(neighborhood == 64 || neighborhood == 8, "encode_points: neighborhood must be 64 or 8, got ",
                  neighborhood);
  points = contiguous(points);
  normals = contiguous(normals);
  encoder_params = contiguous(encoder_params);
  const std::int64_t n = points.size(0);
  const EncoderSettings settings{static_cast<float>(voxel_size), static_cast<std::int32_t>(neighborhood),
                                 static_cast<float>(min_pair_weight)};
  DeviceScope scope(points);
  const Tensor workspace =
      empty(points, {encode_points_workspace_bytes(scope.context, n, settings.neighborhood)}, ScalarType::Byte);
  Tensor voxel_coords, features, weights;
  spslam::encode_points(scope.context, data<float>(points), data<float>(normals), n, data<float>(encoder_params),
                        settings, mutable_data<std::uint8_t>(workspace), [&](std::int64_t count) {
                          voxel_coords = empty(points, {count, 3}, ScalarType::Int);
                          features = empty(points, {count, kPriorFeatures}, ScalarType::Float);
                          weights = empty(points, {count}, ScalarType::Float);
                          return EncodedVoxels{mutable_data<std::int32_t>(voxel_coords), mutable_data<float>(features),
                                               mutable_data<float>(weights)};
                        });
  return {voxel_coords, features, weights};
}

Tensor random_embeddings(Tensor voxel_coords, std::int64_t seed, double scale) {
  voxel_coords = contiguous(voxel_coords);
  DeviceScope scope(voxel_coords);
  const Tensor embeddings = empty(voxel_coords, {voxel_coords.size(0), kPriorFeatures}, ScalarType::Float);
  spslam::random_embeddings(scope.context, data<std::int32_t>(voxel_coords), voxel_coords.size(0), seed,
                            static_cast<float>(scale), mutable_data<float>(embeddings));
  return embeddings;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "depth_normals(Tensor depth, Tensor pixels, float fx, float fy, float cx, float cy, int step_px, float "
      "max_jump) -> Tensor");
  m.def(
      "encode_points(Tensor points, Tensor normals, Tensor encoder_params, float voxel_size, int neighborhood, float "
      "min_pair_weight) -> (Tensor, Tensor, Tensor)");
  m.def(
      "fuse_prior_(Tensor(a!) embeddings, Tensor(b!) weights, Tensor voxel_ids, Tensor features, Tensor "
      "feature_weights, float max_weight) -> ()");
  m.def("random_embeddings(Tensor voxel_coords, int seed, float scale) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("depth_normals", TORCH_BOX(&depth_normals));
  m.impl("encode_points", TORCH_BOX(&encode_points));
  m.impl("fuse_prior_", TORCH_BOX(&fuse_prior_));
  m.impl("random_embeddings", TORCH_BOX(&random_embeddings));
}

}  // namespace spslam::bindings
