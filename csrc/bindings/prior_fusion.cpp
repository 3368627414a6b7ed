#include "spslam/prior_fusion.h"

#include <functional>

#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

void fuse_prior_(Tensor embeddings, Tensor weights, Tensor voxel_ids, Tensor features, Tensor feature_weights,
                 double max_weight) {
  voxel_ids = as_contiguous(voxel_ids);
  features = as_contiguous(features);
  feature_weights = as_contiguous(feature_weights);
  const std::int64_t count = voxel_ids.numel();
  SPS_CHECK(has_shape(voxel_ids, {count}) && has_shape(features, {count, kPriorFeatures}) &&
                has_shape(feature_weights, {count}) && has_shape(embeddings, {-1, kPriorFeatures}) &&
                has_shape(weights, {embeddings.size(0)}),
            "fuse_prior_: embeddings and features must have 8 channels and one weight per row");
  DeviceScope scope(embeddings);
  fuse_prior(scope.context, data<std::int32_t>(voxel_ids), data<float>(features), data<float>(feature_weights), count,
             embeddings.size(0), static_cast<float>(max_weight), mutable_data<float>(embeddings),
             mutable_data<float>(weights));
}

Tensor depth_normals(Tensor depth, Tensor pixels, double fx, double fy, double cx, double cy, std::int64_t step_px,
                     double max_jump) {
  constexpr std::int64_t kMaxStep = 65535;
  SPS_CHECK(has_shape(depth, {-1, -1}) && has_shape(pixels, {-1, 2}),
            "depth_normals: depth and pixels must have shapes [H, W] and [N, 2]");
  check_count("depth_normals", "height", depth.size(0), 0);
  check_count("depth_normals", "width", depth.size(1), 0);
  SPS_CHECK(step_px >= 1 && step_px <= kMaxStep, "depth_normals: step_px must be in [1, ", kMaxStep, "], got ",
            step_px);
  depth = as_contiguous(depth);
  pixels = as_contiguous(pixels);
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

void check_points(const char* function, const Tensor& points, const Tensor& normals) {
  SPS_CHECK(has_shape(points, {-1, 3}) && same_shape(normals, points), function,
            ": points and normals must have shape [N, 3]");
}

EncoderSettings checked_settings(const char* function, const Tensor& params, double voxel_size,
                                 std::int64_t neighborhood, double min_pair_weight, bool tf32) {
  SPS_CHECK(params.numel() == kEncoderParameters, function, ": encoder_params must have ", kEncoderParameters,
            " numbers, got ", params.numel());
  SPS_CHECK(neighborhood == 64 || neighborhood == 8, function, ": neighborhood must be 64 or 8, got ", neighborhood);
  return {static_cast<float>(voxel_size), static_cast<std::int32_t>(neighborhood), static_cast<float>(min_pair_weight),
          tf32};
}

std::tuple<Tensor, Tensor, Tensor> encode_points(Tensor points, Tensor normals, Tensor encoder_params,
                                                 double voxel_size, std::int64_t neighborhood, double min_pair_weight,
                                                 bool tf32) {
  const EncoderSettings settings =
      checked_settings("encode_points", encoder_params, voxel_size, neighborhood, min_pair_weight, tf32);
  check_points("encode_points", points, normals);
  points = as_contiguous(points);
  normals = as_contiguous(normals);
  encoder_params = as_contiguous(encoder_params);
  DeviceScope scope(points);
  Scratch scratch(points);
  Tensor voxel_coords, features, weights;
  spslam::encode_points(scope.context, data<float>(points), data<float>(normals), points.size(0),
                        data<float>(encoder_params), settings, std::ref(scratch), [&](std::int64_t count) {
                          voxel_coords = empty(points, {count, 3}, ScalarType::Int);
                          features = empty(points, {count, kPriorFeatures}, ScalarType::Float);
                          weights = empty(points, {count}, ScalarType::Float);
                          return EncodedVoxels{mutable_data<std::int32_t>(voxel_coords), mutable_data<float>(features),
                                               mutable_data<float>(weights)};
                        });
  return {voxel_coords, features, weights};
}

// Places in the lists of numbers of encode_frame_; spslam/ops/encode_frame.py fills them.
enum class Scalar { kVoxelSize, kMinPairWeight, kMinWeight, kKappa, kMaxWeight, kCount };
enum class Integer { kNumVoxels, kMaxVoxels, kNeighborhood, kMaxPoints, kFuseKnown, kTf32, kCount };

// hash_keys, hash_values, voxel_coords, corner_ids, embeddings and weights of a volume.
FeatureVolume checked_volume(const std::vector<Tensor>& tensors, std::int64_t num_voxels, std::int64_t max_voxels) {
  SPS_CHECK(tensors.size() == 6, "encode_frame_: volume must be 6 tensors, got ", tensors.size());
  const Tensor &keys = tensors[0], &values = tensors[1], &coords = tensors[2], &corners = tensors[3],
               &embeddings = tensors[4], &weights = tensors[5];
  const std::int64_t rows = weights.numel(), slots = keys.numel();
  SPS_CHECK(has_shape(weights, {rows}) && has_shape(coords, {rows, 3}) && has_shape(corners, {rows, 8}) &&
                has_shape(embeddings, {rows, kPriorFeatures}),
            "encode_frame_: the volume's tensors must have as many rows each");
  SPS_CHECK(slots >= 2 && (slots & (slots - 1)) == 0 && values.numel() == slots,
            "encode_frame_: hash_keys must have a power of two of slots, got ", slots);
  SPS_CHECK(0 <= num_voxels && num_voxels <= max_voxels && max_voxels <= rows && max_voxels <= slots / 2,
            "encode_frame_: num_voxels, max_voxels and the volume's room must not decrease in this order, got ",
            num_voxels, ", ", max_voxels, " and ", rows);
  to_int32("encode_frame_", "max_voxels", max_voxels);
  return {mutable_data<std::int64_t>(keys),
          mutable_data<std::int32_t>(values),
          slots,
          mutable_data<std::int32_t>(coords),
          mutable_data<std::int32_t>(corners),
          mutable_data<float>(embeddings),
          mutable_data<float>(weights),
          num_voxels,
          max_voxels};
}

FusionSettings load_fusion(const Tensor& encoder_params, const Scalars<Scalar>& scalars,
                           const Integers<Integer>& integers) {
  SPS_CHECK(integers[Integer::kMaxPoints] >= 0, "encode_frame_: max_points must be at least 0, got ",
            integers[Integer::kMaxPoints]);
  return {
      checked_settings("encode_frame_", encoder_params, scalars[Scalar::kVoxelSize], integers[Integer::kNeighborhood],
                       scalars[Scalar::kMinPairWeight], integers.as<bool>(Integer::kTf32)),
      integers[Integer::kMaxPoints],
      scalars.as<float>(Scalar::kMinWeight),
      scalars.as<float>(Scalar::kKappa),
      scalars.as<float>(Scalar::kMaxWeight),
      integers.as<bool>(Integer::kFuseKnown)};
}

// `bounds` lies on the CPU: the caller needs it there.
std::int64_t encode_frame_(std::vector<Tensor> volume, Tensor points, Tensor normals, Tensor encoder_params,
                           std::vector<double> scalar_list, std::vector<std::int64_t> integer_list, Tensor bounds) {
  const Scalars<Scalar> scalars("encode_frame_", "scalars", scalar_list);
  const Integers<Integer> integers("encode_frame_", "integers", integer_list);
  const FusionSettings settings = load_fusion(encoder_params, scalars, integers);
  const FeatureVolume into = checked_volume(volume, integers[Integer::kNumVoxels], integers[Integer::kMaxVoxels]);
  SPS_CHECK(bounds.numel() == 6, "encode_frame_: bounds must have 6 numbers, got ", bounds.numel());
  check_points("encode_frame_", points, normals);
  points = as_contiguous(points);
  normals = as_contiguous(normals);
  encoder_params = as_contiguous(encoder_params);
  DeviceScope scope(points);
  Scratch scratch(points);
  const EncodedFrame frame = encode_frame(scope.context, into, data<float>(points), data<float>(normals),
                                          points.size(0), data<float>(encoder_params), settings, std::ref(scratch));
  float* bound = mutable_data<float>(bounds);
  for (int a = 0; a < 3; ++a) {
    bound[a] = frame.low[a];
    bound[3 + a] = frame.high[a];
  }
  return frame.new_voxels;
}

Tensor random_embeddings(Tensor voxel_coords, std::int64_t seed, double scale) {
  SPS_CHECK(has_shape(voxel_coords, {-1, 3}), "random_embeddings: voxel_coords must have shape [M, 3]");
  voxel_coords = as_contiguous(voxel_coords);
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
      "min_pair_weight, bool tf32=True) -> (Tensor, Tensor, Tensor)");
  m.def(
      "encode_frame_(Tensor(a!)[] volume, Tensor points, Tensor normals, Tensor encoder_params, float[] scalars, "
      "int[] integers, Tensor(b!) bounds) -> int");
  m.def(
      "fuse_prior_(Tensor(a!) embeddings, Tensor(b!) weights, Tensor voxel_ids, Tensor features, Tensor "
      "feature_weights, float max_weight) -> ()");
  m.def("random_embeddings(Tensor voxel_coords, int seed, float scale) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("depth_normals", TORCH_BOX(&depth_normals));
  m.impl("encode_points", TORCH_BOX(&encode_points));
  m.impl("encode_frame_", TORCH_BOX(&encode_frame_));
  m.impl("fuse_prior_", TORCH_BOX(&fuse_prior_));
  m.impl("random_embeddings", TORCH_BOX(&random_embeddings));
}

}  // namespace spslam::bindings
