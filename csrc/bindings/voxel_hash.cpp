#include "spslam/voxel_hash.h"

#include <string>

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

std::int64_t checked_capacity(const char* function, const Tensor& hash_keys, const Tensor& hash_values) {
  const std::int64_t capacity = hash_keys.numel();
  SPS_CHECK(capacity >= 2 && (capacity & (capacity - 1)) == 0, function,
            ": hash_keys must have a power of two of slots, got ", capacity);
  SPS_CHECK(hash_values.numel() == capacity, function, ": hash_values must have as many slots as hash_keys, got ",
            hash_values.numel());
  return capacity;
}

void check_coords(const char* function, const Tensor& voxel_coords) {
  SPS_CHECK(has_shape(voxel_coords, {-1, 3}), function, ": voxel_coords must have shape [N, 3]");
}

// A table is kept half empty at least: every probe then ends, and soon.
void check_room(const char* function, std::int64_t capacity, std::int64_t voxels) {
  SPS_CHECK(voxels <= capacity / 2, function, ": hash table must stay at most half full, got ", voxels, " voxels for ",
            capacity, " slots");
}

// The coordinates that a table lacks, packed in the first rows of `keys`.
struct Absent {
  Tensor keys;
  AbsentVoxels found;

  Absent(const Context& context, const Tensor& hash_keys, const Tensor& hash_values, const Tensor& voxel_coords)
      : keys(empty(hash_keys, {voxel_coords.size(0)}, ScalarType::Long)) {
    const std::int64_t n = voxel_coords.size(0);
    const Tensor workspace = empty(hash_keys, {voxel_hash_workspace_bytes(context, n)}, ScalarType::Byte);
    found = spslam::voxel_hash_absent(context, data<std::int64_t>(hash_keys), data<std::int32_t>(hash_values),
                                      hash_keys.numel(), data<std::int32_t>(voxel_coords), n,
                                      mutable_data<std::uint8_t>(workspace), mutable_data<std::int64_t>(keys));
  }

  void check_range(const char* function) const {
    SPS_CHECK(found.out_of_range == 0, function, ": voxel_coords must lie in [-2^20, 2^20 - 1], got ",
              found.out_of_range, " rows outside");
  }

  Tensor coords(const Context& context) const {
    const Tensor coords = empty(keys, {found.count, 3}, ScalarType::Int);
    voxel_hash_unpack(context, data<std::int64_t>(keys), found.count, mutable_data<std::int32_t>(coords));
    return coords;
  }
};

// `function` is named in an error: the caller's, which may be more than this op.
Tensor voxel_hash_absent(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords, std::string function) {
  checked_capacity(function.c_str(), hash_keys, hash_values);
  check_coords(function.c_str(), voxel_coords);
  hash_keys = as_contiguous(hash_keys);
  hash_values = as_contiguous(hash_values);
  DeviceScope scope(hash_keys);
  const Absent absent(scope.context, hash_keys, hash_values, as_contiguous(voxel_coords));
  absent.check_range(function.c_str());
  return absent.coords(scope.context);
}

Tensor voxel_hash_insert(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords, std::int64_t first_id) {
  const char* name = "voxel_hash_insert";
  const std::int64_t capacity = checked_capacity(name, hash_keys, hash_values);
  check_coords(name, voxel_coords);
  SPS_CHECK(first_id >= 0, name, ": first_id must be at least 0, got ", first_id);
  std::int64_t* const keys = mutable_data<std::int64_t>(hash_keys);  // before they are read as contiguous
  std::int32_t* const values = mutable_data<std::int32_t>(hash_values);
  DeviceScope scope(hash_keys);
  const Absent absent(scope.context, hash_keys, hash_values, as_contiguous(voxel_coords));
  const AbsentVoxels& found = absent.found;
  absent.check_range(name);
  check_room(name, capacity, first_id);
  check_room(name, capacity, first_id + found.count);
  SPS_CHECK(found.count <= found.empty_slots, name, ": first_id must be the number of voxels in the table, got ",
            first_id, " for a table with ", found.empty_slots, " empty slots of ", capacity);
  voxel_hash_assign(scope.context, keys, values, capacity, data<std::int64_t>(absent.keys), found.count,
                    to_int32(name, "first_id", first_id));
  return absent.coords(scope.context);
}

void voxel_hash_build(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords) {
  const char* name = "voxel_hash_build_";
  const std::int64_t capacity = checked_capacity(name, hash_keys, hash_values);
  check_coords(name, voxel_coords);
  voxel_coords = as_contiguous(voxel_coords);
  const std::int64_t n = voxel_coords.size(0);
  check_room(name, capacity, n);
  std::int64_t* const keys = mutable_data<std::int64_t>(hash_keys);
  std::int32_t* const values = mutable_data<std::int32_t>(hash_values);
  DeviceScope scope(hash_keys);
  const Tensor packed = empty(hash_keys, {n}, ScalarType::Long);
  voxel_hash_pack(scope.context, data<std::int32_t>(voxel_coords), n, mutable_data<std::int64_t>(packed));
  torch::stable::fill_(hash_keys, -1);
  voxel_hash_assign(scope.context, keys, values, capacity, data<std::int64_t>(packed), n, 0);
}

Tensor voxel_hash_find(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords) {
  const std::int64_t capacity = checked_capacity("voxel_hash_find", hash_keys, hash_values);
  check_coords("voxel_hash_find", voxel_coords);
  hash_keys = as_contiguous(hash_keys);
  hash_values = as_contiguous(hash_values);
  voxel_coords = as_contiguous(voxel_coords);
  DeviceScope scope(hash_keys);
  const Tensor voxel_ids = empty(hash_keys, {voxel_coords.size(0)}, ScalarType::Int);
  spslam::voxel_hash_find(scope.context, data<std::int64_t>(hash_keys), data<std::int32_t>(hash_values), capacity,
                          data<std::int32_t>(voxel_coords), voxel_ids.numel(), mutable_data<std::int32_t>(voxel_ids));
  return voxel_ids;
}

void voxel_hash_update_corner_ids(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords, Tensor corner_ids,
                                  std::int64_t first_new) {
  const char* name = "voxel_hash_update_corner_ids";
  const std::int64_t capacity = checked_capacity(name, hash_keys, hash_values);
  check_coords(name, voxel_coords);
  hash_keys = as_contiguous(hash_keys);
  hash_values = as_contiguous(hash_values);
  voxel_coords = as_contiguous(voxel_coords);
  const std::int64_t voxels = voxel_coords.size(0);
  SPS_CHECK(has_shape(corner_ids, {voxels, 8}), name, ": corner_ids must have shape [", voxels, ", 8]");
  SPS_CHECK(first_new >= 0 && first_new <= voxels, name, ": first_new must be in [0, ", voxels, "], got ", first_new);
  DeviceScope scope(hash_keys);
  spslam::voxel_hash_update_corner_ids(scope.context, data<std::int64_t>(hash_keys), data<std::int32_t>(hash_values),
                                       capacity, data<std::int32_t>(voxel_coords), voxels, first_new,
                                       mutable_data<std::int32_t>(corner_ids));
}

std::tuple<Tensor, Tensor> voxel_hash_lookup(Tensor hash_keys, Tensor hash_values, Tensor corner_ids, Tensor points,
                                             double voxel_size) {
  const char* name = "voxel_hash_lookup";
  const std::int64_t capacity = checked_capacity(name, hash_keys, hash_values);
  SPS_CHECK(has_shape(corner_ids, {-1, 8}) && has_shape(points, {-1, 3}), name,
            ": corner_ids and points must have shapes [V, 8] and [N, 3]");
  hash_keys = as_contiguous(hash_keys);
  hash_values = as_contiguous(hash_values);
  corner_ids = as_contiguous(corner_ids);
  points = as_contiguous(points);
  const std::int64_t n = points.size(0);
  DeviceScope scope(hash_keys);
  const Tensor rows = empty(hash_keys, {n, 8}, ScalarType::Int);
  const Tensor local_coords = empty(points, {n, 3}, points.scalar_type());
  dispatch_floating(name, points, [&](auto zero) {
    using T = decltype(zero);
    spslam::voxel_hash_lookup(scope.context, data<std::int64_t>(hash_keys), data<std::int32_t>(hash_values), capacity,
                              data<std::int32_t>(corner_ids), corner_ids.size(0), data<T>(points), n,
                              static_cast<T>(voxel_size), mutable_data<std::int32_t>(rows),
                              mutable_data<T>(local_coords));
  });
  return {local_coords, rows};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "voxel_hash_absent(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords, "
      "str function='voxel_hash_absent') -> Tensor");
  m.def("voxel_hash_insert(Tensor(a!) hash_keys, Tensor(b!) hash_values, Tensor voxel_coords, int first_id) -> Tensor");
  m.def("voxel_hash_build_(Tensor(a!) hash_keys, Tensor(b!) hash_values, Tensor voxel_coords) -> ()");
  m.def("voxel_hash_find(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords) -> Tensor");
  m.def(
      "voxel_hash_update_corner_ids(Tensor hash_keys, Tensor hash_values, Tensor voxel_coords, Tensor(a!) corner_ids, "
      "int first_new) -> ()");
  m.def(
      "voxel_hash_lookup(Tensor hash_keys, Tensor hash_values, Tensor corner_ids, Tensor points, float voxel_size) -> "
      "(Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("voxel_hash_absent", TORCH_BOX(&voxel_hash_absent));
  m.impl("voxel_hash_insert", TORCH_BOX(&voxel_hash_insert));
  m.impl("voxel_hash_build_", TORCH_BOX(&voxel_hash_build));
  m.impl("voxel_hash_find", TORCH_BOX(&voxel_hash_find));
  m.impl("voxel_hash_update_corner_ids", TORCH_BOX(&voxel_hash_update_corner_ids));
  m.impl("voxel_hash_lookup", TORCH_BOX(&voxel_hash_lookup));
}

}  // namespace spslam::bindings
