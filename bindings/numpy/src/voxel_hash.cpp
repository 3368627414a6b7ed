#include "spslam/voxel_hash.h"

#include <algorithm>

#include "arrays.h"
#include "spslam/types/voxel_table.h"

namespace spslam::numpy {
namespace {

bool power_of_two(std::int64_t capacity) {
  return capacity >= 2 && (capacity & (capacity - 1)) == 0;
}

template <class Keys>
std::int64_t checked_capacity(const char* function, const Keys& keys) {
  check(power_of_two(keys.numel()), {function, "hash_keys"}, "have a power of two of slots", keys.numel());
  return keys.numel();
}

// A table is kept half empty at least: every probe then ends, and soon.
void check_room(const char* function, std::int64_t capacity, std::int64_t voxels) {
  if (voxels <= capacity / 2) return;
  throw std::runtime_error(std::string(function) + ": hash table must stay at most half full, got " +
                           std::to_string(voxels) + " voxels for " + std::to_string(capacity) + " slots");
}

py::tuple new_voxel_hash(std::int64_t capacity) {
  check(power_of_two(capacity), {"new_voxel_hash", "capacity"}, "be a power of two", capacity);
  auto keys = empty<std::int64_t>({capacity});
  auto values = empty<std::int32_t>({capacity});
  std::fill_n(keys.mutable_data(), capacity, kEmptyVoxelKey);
  std::fill_n(values.mutable_data(), capacity, 0);
  return py::make_tuple(keys, values);
}

// The coordinates that a table lacks, packed in the first rows of `packed`.
struct Absent {
  std::vector<std::int64_t> packed;
  AbsentVoxels found;

  Absent(const char* function, const std::int64_t* keys, const std::int32_t* values, std::int64_t capacity,
         const Input<std::int32_t>& coords)
      : packed(coords.size(0)) {
    const std::int64_t n = coords.size(0);
    std::vector<std::uint8_t> workspace(voxel_hash_workspace_bytes(kCpu, n));
    found = without_gil([&] {
      return spslam::voxel_hash_absent(kCpu, keys, values, capacity, coords.data(), n, workspace.data(), packed.data());
    });
    if (found.out_of_range == 0) return;
    throw std::runtime_error(std::string(function) + ": voxel_coords must lie in [-2^20, 2^20 - 1], got " +
                             std::to_string(found.out_of_range) + " rows outside");
  }

  py::array_t<std::int32_t> coords() const {
    auto coords = empty<std::int32_t>({found.count, 3});
    std::int32_t* out = coords.mutable_data();
    without_gil([&] { voxel_hash_unpack(kCpu, packed.data(), found.count, out); });
    return coords;
  }
};

py::array_t<std::int32_t> absent(const py::object& hash_keys, const py::object& hash_values,
                                 const py::object& voxel_coords) {
  const char* name = "voxel_hash_absent";
  const Input<std::int64_t> keys({name, "hash_keys"}, hash_keys, {"capacity"});
  const std::int64_t capacity = checked_capacity(name, keys);
  const Input<std::int32_t> values({name, "hash_values"}, hash_values, {capacity});
  const Input<std::int32_t> coords({name, "voxel_coords"}, voxel_coords, {"N", 3});
  return Absent(name, keys.data(), values.data(), capacity, coords).coords();
}

py::array_t<std::int32_t> insert(const py::object& hash_keys, const py::object& hash_values,
                                 const py::object& voxel_coords, std::int64_t first_id) {
  const char* name = "voxel_hash_insert";
  InOut<std::int64_t> keys({name, "hash_keys"}, hash_keys, {"capacity"});
  const std::int64_t capacity = checked_capacity(name, keys);
  InOut<std::int32_t> values({name, "hash_values"}, hash_values, {capacity});
  const Input<std::int32_t> coords({name, "voxel_coords"}, voxel_coords, {"N", 3});
  check(first_id >= 0, {name, "first_id"}, "be at least 0", first_id);
  const Absent absent(name, keys.data(), values.data(), capacity, coords);
  const AbsentVoxels& found = absent.found;
  check_room(name, capacity, first_id);
  check_room(name, capacity, first_id + found.count);
  if (found.count > found.empty_slots) {
    throw std::runtime_error(std::string(name) + ": first_id must be the number of voxels in the table, got " +
                             std::to_string(first_id) + " for a table with " + std::to_string(found.empty_slots) +
                             " empty slots of " + std::to_string(capacity));
  }
  std::int64_t* slots = keys.data();
  std::int32_t* ids = values.data();
  without_gil([&] {
    voxel_hash_assign(kCpu, slots, ids, capacity, absent.packed.data(), found.count,
                      static_cast<std::int32_t>(first_id));
  });
  return absent.coords();
}

void build(const py::object& hash_keys, const py::object& hash_values, const py::object& voxel_coords) {
  const char* name = "voxel_hash_build_";
  InOut<std::int64_t> keys({name, "hash_keys"}, hash_keys, {"capacity"});
  const std::int64_t capacity = checked_capacity(name, keys);
  InOut<std::int32_t> values({name, "hash_values"}, hash_values, {capacity});
  const Input<std::int32_t> coords({name, "voxel_coords"}, voxel_coords, {"V", 3});
  const std::int64_t n = coords.size(0);
  for (std::int64_t i = 0; i < 3 * n; ++i) {
    const std::int32_t c = coords.data()[i];
    check(c >= kVoxelCoordMin && c <= kVoxelCoordMax, {name, "voxel_coords"}, "lie in [-2^20, 2^20 - 1]", c);
  }
  check_room(name, capacity, n);
  std::vector<std::int64_t> packed(n);
  std::int64_t* slots = keys.data();
  std::int32_t* ids = values.data();
  without_gil([&] {
    voxel_hash_pack(kCpu, coords.data(), n, packed.data());
    std::fill_n(slots, capacity, kEmptyVoxelKey);
    voxel_hash_assign(kCpu, slots, ids, capacity, packed.data(), n, 0);
  });
}

py::array_t<std::int32_t> find(const py::object& hash_keys, const py::object& hash_values,
                               const py::object& voxel_coords) {
  const char* name = "voxel_hash_find";
  const Input<std::int64_t> keys({name, "hash_keys"}, hash_keys, {"capacity"});
  const std::int64_t capacity = checked_capacity(name, keys);
  const Input<std::int32_t> values({name, "hash_values"}, hash_values, {capacity});
  const Input<std::int32_t> coords({name, "voxel_coords"}, voxel_coords, {"N", 3});
  auto ids = empty<std::int32_t>({coords.size(0)});
  std::int32_t* out = ids.mutable_data();
  without_gil([&] { voxel_hash_find(kCpu, keys.data(), values.data(), capacity, coords.data(), coords.size(0), out); });
  return ids;
}

void update_corner_ids(const py::object& hash_keys, const py::object& hash_values, const py::object& voxel_coords,
                       const py::object& corner_ids, std::int64_t first_new) {
  const char* name = "voxel_hash_update_corner_ids";
  const Input<std::int64_t> keys({name, "hash_keys"}, hash_keys, {"capacity"});
  const std::int64_t capacity = checked_capacity(name, keys);
  const Input<std::int32_t> values({name, "hash_values"}, hash_values, {capacity});
  const Input<std::int32_t> coords({name, "voxel_coords"}, voxel_coords, {"V", 3});
  const std::int64_t voxels = coords.size(0);
  InOut<std::int32_t> rows({name, "corner_ids"}, corner_ids, {voxels, 8});
  check(first_new >= 0 && first_new <= voxels, {name, "first_new"}, "be in [0, " + std::to_string(voxels) + "]",
        first_new);
  without_gil([&] {
    voxel_hash_update_corner_ids(kCpu, keys.data(), values.data(), capacity, coords.data(), voxels, first_new,
                                 rows.data());
  });
}

py::object lookup(const py::object& hash_keys, const py::object& hash_values, const py::object& corner_ids,
                  const py::object& points, double voxel_size) {
  const char* name = "voxel_hash_lookup";
  const Input<std::int64_t> keys({name, "hash_keys"}, hash_keys, {"capacity"});
  const std::int64_t capacity = checked_capacity(name, keys);
  const Input<std::int32_t> values({name, "hash_values"}, hash_values, {capacity});
  const Input<std::int32_t> corners({name, "corner_ids"}, corner_ids, {"V", 8});
  check(voxel_size > 0, {name, "voxel_size"}, "be positive", voxel_size);
  return dispatch_floating({name, "points"}, points, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Input<T> at({name, "points"}, points, {"N", 3});
    auto rows = empty<std::int32_t>({at.size(0), 8});
    auto local = empty<T>({at.size(0), 3});
    std::int32_t* rows_out = rows.mutable_data();
    T* local_out = local.mutable_data();
    without_gil([&] {
      voxel_hash_lookup(kCpu, keys.data(), values.data(), capacity, corners.data(), corners.size(0), at.data(),
                        at.size(0), static_cast<T>(voxel_size), rows_out, local_out);
    });
    return py::make_tuple(rows, local);
  });
}

}  // namespace

void define_voxel_hash(py::module_& m) {
  m.def("new_voxel_hash", &new_voxel_hash, py::arg("capacity"),
        "An empty table of `capacity` slots, a power of two: hash_keys int64 [capacity], hash_values int32 [capacity]. "
        "It holds half as many voxels.");
  m.def("voxel_hash_absent", &absent, py::arg("hash_keys"), py::arg("hash_values"), py::arg("voxel_coords"),
        "The coordinates int32 [M, 3] among int32 [N, 3] that the table lacks, each once, in sorted order.");
  m.def("voxel_hash_insert", &insert, py::arg("hash_keys"), py::arg("hash_values"), py::arg("voxel_coords"),
        py::arg("first_id"),
        "Enters the coordinates int32 [N, 3] that the table lacks, in place, with ids from `first_id` on in sorted "
        "order. Returns them, int32 [M, 3].");
  m.def("voxel_hash_build_", &build, py::arg("hash_keys"), py::arg("hash_values"), py::arg("voxel_coords"),
        "Empties the table and enters row i of the distinct `voxel_coords` int32 [V, 3] with id i.");
  m.def("voxel_hash_find", &find, py::arg("hash_keys"), py::arg("hash_values"), py::arg("voxel_coords"),
        "Ids int32 [N] of coordinates int32 [N, 3], -1 where absent or out of range.");
  m.def("voxel_hash_update_corner_ids", &update_corner_ids, py::arg("hash_keys"), py::arg("hash_values"),
        py::arg("voxel_coords"), py::arg("corner_ids"), py::arg("first_new"),
        "Brings corner_ids int32 [V, 8] up to date, in place, after the vertices from `first_new` on came in.");
  m.def("voxel_hash_lookup", &lookup, py::arg("hash_keys"), py::arg("hash_values"), py::arg("corner_ids"),
        py::arg("points"), py::arg("voxel_size"),
        "The cell around each point [N, 3] (m): cell_corner_ids int32 [N, 8], -1 outside, and local_coords [N, 3].");
}

}  // namespace spslam::numpy
