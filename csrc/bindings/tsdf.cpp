#include "spslam/tsdf.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

std::int32_t image_side(const char* name, std::int64_t size) {
  SPS_CHECK(size >= 0 && size <= 1 << 14, name, ": images must have at most 16384 pixels per side, got ", size);
  return static_cast<std::int32_t>(size);
}

Tensor measure_planes(Tensor depth, std::vector<double> intrinsics, double noise_floor, double noise_growth,
                      bool shared_noise) {
  constexpr char kName[] = "measure_planes";
  SPS_CHECK(depth.dim() == 2, kName, ": depth must have shape [H, W]");
  DeviceScope scope(depth);
  depth = as_contiguous(depth);
  const DepthImage image{data<float>(depth), image_side(kName, depth.size(1)), image_side(kName, depth.size(0)),
                         load_intrinsics(kName, intrinsics)};
  const Tensor planes = empty(depth, {depth.size(0), depth.size(1), kPlaneSize}, ScalarType::Float);
  const PlaneNoise noise{{static_cast<float>(noise_floor), static_cast<float>(noise_growth)}, shared_noise};
  spslam::measure_planes(scope.context, image, noise, mutable_data<float>(planes));
  return planes;
}

PlaneFrame load_frame(const char* name, const Tensor& planes, const Tensor& pose,
                      const std::vector<double>& intrinsics) {
  SPS_CHECK(has_shape(planes, {-1, -1, kPlaneSize}), name, ": planes must have shape [H, W, 5]");
  SPS_CHECK(has_shape(pose, {kPoseSize}), name, ": pose must have shape [7]");
  return {data<float>(planes),
          nullptr,
          data<float>(pose),
          image_side(name, planes.size(1)),
          image_side(name, planes.size(0)),
          load_intrinsics(name, intrinsics)};
}

// A table of blocks that is read; its tensors must outlive the launch.
struct HashTable {
  HashTable(const char* name, const Tensor& hash_keys, const Tensor& hash_values)
      : keys(as_contiguous(hash_keys)), values(as_contiguous(hash_values)) {
    const std::int64_t capacity = keys.numel();
    SPS_CHECK(capacity >= 2 && (capacity & (capacity - 1)) == 0 && values.numel() == capacity, name,
              ": hash_keys and hash_values must have a power of two of slots");
  }

  VoxelTable view() const { return {data<std::int64_t>(keys), data<std::int32_t>(values), keys.numel() - 1}; }

  Tensor keys, values;
};

DepthNoise load_noise(const char* name, const std::vector<double>& noise) {
  SPS_CHECK(noise.size() == 2 && noise[0] >= 0.0 && noise[1] >= 0.0, name, ": noise must be two numbers of at least 0");
  return {static_cast<float>(noise[0]), static_cast<float>(noise[1])};
}

// The blocks that a frame's planes touch; `name` is the function that errors name.
Tensor touched_blocks(const char* name, const DeviceScope& scope, const Tensor& planes, const Tensor& pose,
                      const std::vector<double>& intrinsics, double voxel_size, double truncation,
                      const std::vector<double>& noise, std::int64_t step) {
  check_count(name, "step", step);
  SPS_CHECK(voxel_size > 0.0 && truncation > 0.0, name, ": voxel_size and truncation must be positive");
  const TouchOptions options{static_cast<float>(voxel_size), static_cast<float>(truncation), load_noise(name, noise),
                             static_cast<std::int32_t>(step)};
  const Tensor whole = as_contiguous(planes), place = as_contiguous(pose);
  const PlaneFrame frame = load_frame(name, whole, place, intrinsics);
  Tensor coords = empty(planes, {touched_rows(frame, options.step), 3}, ScalarType::Int);
  const std::int64_t written =
      spslam::tsdf_touched_blocks(scope.context, frame, options, mutable_data<std::int32_t>(coords));
  return torch::stable::narrow(coords, 0, 0, written);
}

Tensor tsdf_touched_blocks(Tensor planes, Tensor pose, std::vector<double> intrinsics, double voxel_size,
                           double truncation, std::vector<double> noise, std::int64_t step) {
  const DeviceScope scope(planes);
  return touched_blocks("tsdf_touched_blocks", scope, planes, pose, intrinsics, voxel_size, truncation, noise, step);
}

// Those of the touched blocks that a table lacks, with repetitions: one wait for the device instead of several.
Tensor tsdf_missing_blocks(Tensor planes, Tensor pose, std::vector<double> intrinsics, double voxel_size,
                           double truncation, std::vector<double> noise, std::int64_t step, Tensor hash_keys,
                           Tensor hash_values) {
  constexpr char kName[] = "tsdf_missing_blocks";
  const DeviceScope scope(planes);
  const Tensor touched = touched_blocks(kName, scope, planes, pose, intrinsics, voxel_size, truncation, noise, step);
  const HashTable table(kName, hash_keys, hash_values);
  const std::int64_t n = touched.size(0);
  const Tensor workspace = empty(touched, {tsdf_missing_workspace_bytes(n)}, ScalarType::Byte);
  Tensor missing = empty(touched, {n, 3}, ScalarType::Int);
  const std::int64_t count =
      spslam::tsdf_missing_blocks(scope.context, table.view(), data<std::int32_t>(touched), n,
                                  mutable_data<std::uint8_t>(workspace), mutable_data<std::int32_t>(missing));
  return torch::stable::narrow(missing, 0, 0, count);
}

void check_blocks(const char* name, const Tensor& sdf, const Tensor& weights, const Tensor& colors) {
  SPS_CHECK(has_shape(sdf, {-1, kTsdfBlockVoxels}) && same_shape(weights, sdf) &&
                has_shape(colors, {sdf.size(0), kTsdfBlockVoxels, kTsdfColorSize}),
            name, ": sdf, weights and colors must have shapes [B, 512], [B, 512] and [B, 512, 4]");
}

void tsdf_integrate(Tensor block_coords, Tensor sdf, Tensor weights, Tensor colors, Tensor planes,
                    std::vector<Tensor> image, Tensor pose, std::vector<double> intrinsics, double voxel_size,
                    std::vector<double> truncations, std::vector<double> noise, double max_weight) {
  constexpr char kName[] = "tsdf_integrate_";
  check_blocks(kName, sdf, weights, colors);
  SPS_CHECK(block_coords.dim() == 2 && block_coords.size(1) == 3 && block_coords.size(0) <= sdf.size(0), kName,
            ": block_coords must have shape [B, 3] and at most as many rows as sdf");
  SPS_CHECK(truncations.size() == 2, kName, ": truncations must be two numbers");
  SPS_CHECK(voxel_size > 0.0 && truncations[0] > 0.0 && truncations[1] > 0.0 && max_weight > 0.0, kName,
            ": voxel_size, truncations and max_weight must be positive");
  DeviceScope scope(sdf);
  block_coords = as_contiguous(block_coords);
  planes = as_contiguous(planes);
  pose = as_contiguous(pose);
  PlaneFrame frame = load_frame(kName, planes, pose, intrinsics);
  Tensor color;
  if (!image.empty()) {
    SPS_CHECK(image.size() == 1 && has_shape(image[0], {planes.size(0), planes.size(1), 3}), kName,
              ": color must have shape [H, W, 3]");
    color = as_contiguous(image[0]);
    frame.colors = data<std::uint8_t>(color);
  }
  const TsdfBlocks blocks{
      data<std::int32_t>(block_coords),    mutable_data<float>(sdf), mutable_data<float>(weights),
      mutable_data<std::uint16_t>(colors), block_coords.size(0),     static_cast<float>(voxel_size)};
  const Tensor workspace = empty(sdf, {tsdf_integrate_workspace_bytes(frame)}, ScalarType::Byte);
  const TsdfOptions options{static_cast<float>(truncations[0]), static_cast<float>(truncations[1]),
                            load_noise(kName, noise), static_cast<float>(max_weight)};
  spslam::tsdf_integrate(scope.context, blocks, frame, options, mutable_data<std::uint8_t>(workspace));
}

// The tensors of a field that is read, contiguous; they must outlive the launch.
struct ReadField {
  ReadField(const char* name, const Tensor& hash_keys, const Tensor& hash_values, const Tensor& sdf_rows,
            const Tensor& weight_rows, const Tensor& color_rows)
      : table(name, hash_keys, hash_values),
        sdf(as_contiguous(sdf_rows)),
        weights(as_contiguous(weight_rows)),
        colors(as_contiguous(color_rows)) {
    check_blocks(name, sdf, weights, colors);
  }

  TsdfView view(double voxel_size, double min_weight) const {
    return {table.view(),
            data<float>(sdf),
            data<float>(weights),
            data<std::uint16_t>(colors),
            sdf.size(0),
            static_cast<float>(voxel_size),
            static_cast<float>(min_weight)};
  }

  HashTable table;
  Tensor sdf, weights, colors;
};

std::tuple<Tensor, Tensor, Tensor> tsdf_query(Tensor hash_keys, Tensor hash_values, Tensor sdf, Tensor weights,
                                              Tensor colors, Tensor points, double voxel_size, double min_weight) {
  constexpr char kName[] = "tsdf_query";
  SPS_CHECK(points.dim() == 2 && points.size(1) == 3, kName, ": points must have shape [N, 3]");
  SPS_CHECK(voxel_size > 0.0, kName, ": voxel_size must be positive");
  DeviceScope scope(points);
  const ReadField field(kName, hash_keys, hash_values, sdf, weights, colors);
  points = as_contiguous(points);
  const std::int64_t n = points.size(0);
  const Tensor distance = empty(points, {n}, ScalarType::Float), color = empty(points, {n, 3}, ScalarType::Float);
  const Tensor known = empty(points, {n}, ScalarType::Bool);
  spslam::tsdf_query(scope.context, field.view(voxel_size, min_weight), data<float>(points), n,
                     mutable_data<float>(distance), mutable_data<float>(color), mutable_data<bool>(known));
  return {distance, color, known};
}

std::tuple<Tensor, Tensor, Tensor> tsdf_ray_cast(Tensor hash_keys, Tensor hash_values, Tensor sdf, Tensor weights,
                                                 Tensor colors, Tensor pose, std::vector<double> intrinsics,
                                                 std::vector<std::int64_t> size, std::vector<double> range,
                                                 double voxel_size, double min_weight) {
  constexpr char kName[] = "tsdf_ray_cast";
  SPS_CHECK(has_shape(pose, {kPoseSize}), kName, ": pose must have shape [7]");
  SPS_CHECK(size.size() == 2 && range.size() == 2, kName, ": size must be width, height, and range near, far");
  SPS_CHECK(voxel_size > 0.0, kName, ": voxel_size must be positive");
  DeviceScope scope(sdf);
  const ReadField field(kName, hash_keys, hash_values, sdf, weights, colors);
  pose = as_contiguous(pose);
  const std::int32_t width = image_side(kName, size[0]), height = image_side(kName, size[1]);
  const RayCastCamera camera{
      data<float>(pose),           width, height, load_intrinsics(kName, intrinsics), static_cast<float>(range[0]),
      static_cast<float>(range[1])};
  const Tensor depth = empty(sdf, {height, width}, ScalarType::Float);
  const Tensor normals = empty(sdf, {height, width, 3}, ScalarType::Float);
  const Tensor color = empty(sdf, {height, width, 3}, ScalarType::Float);
  spslam::tsdf_ray_cast(scope.context, field.view(voxel_size, min_weight), camera, mutable_data<float>(depth),
                        mutable_data<float>(normals), mutable_data<float>(color));
  return {depth, normals, color};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "measure_planes(Tensor depth, float[] intrinsics, float noise_floor, float noise_growth, bool shared_noise) -> "
      "Tensor");
  m.def(
      "tsdf_missing_blocks(Tensor planes, Tensor pose, float[] intrinsics, float voxel_size, float truncation, "
      "float[] noise, int step, Tensor hash_keys, Tensor hash_values) -> Tensor");
  m.def(
      "tsdf_touched_blocks(Tensor planes, Tensor pose, float[] intrinsics, float voxel_size, float truncation, "
      "float[] noise, int step) -> Tensor");
  m.def(
      "tsdf_integrate_(Tensor block_coords, Tensor(a!) sdf, Tensor(b!) weights, Tensor(c!) colors, Tensor planes, "
      "Tensor[] image, Tensor pose, float[] intrinsics, float voxel_size, float[] truncations, float[] noise, "
      "float max_weight) -> ()");
  m.def(
      "tsdf_query(Tensor hash_keys, Tensor hash_values, Tensor sdf, Tensor weights, Tensor colors, Tensor points, "
      "float voxel_size, float min_weight) -> (Tensor, Tensor, Tensor)");
  m.def(
      "tsdf_ray_cast(Tensor hash_keys, Tensor hash_values, Tensor sdf, Tensor weights, Tensor colors, Tensor pose, "
      "float[] intrinsics, int[] size, float[] range, float voxel_size, float min_weight) -> (Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("measure_planes", TORCH_BOX(&measure_planes));
  m.impl("tsdf_missing_blocks", TORCH_BOX(&tsdf_missing_blocks));
  m.impl("tsdf_touched_blocks", TORCH_BOX(&tsdf_touched_blocks));
  m.impl("tsdf_integrate_", TORCH_BOX(&tsdf_integrate));
  m.impl("tsdf_query", TORCH_BOX(&tsdf_query));
  m.impl("tsdf_ray_cast", TORCH_BOX(&tsdf_ray_cast));
}

}  // namespace spslam::bindings
