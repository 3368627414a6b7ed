#include "spslam/marching_cubes.h"

#include <algorithm>

#include "arrays.h"

namespace spslam::numpy {
namespace {

py::tuple mesh(const py::object& cell_coords, const py::object& values, double level) {
  const char* name = "marching_cubes";
  const Input<float> field({name, "values"}, values, {"M", "n + 1", "n + 1", "n + 1"});
  const std::int64_t count = field.size(0), side = field.size(1);
  const Input<float> cubic({name, "values"}, values, {count, side, side, side});
  check(side >= 2, {name, "values"}, "have at least 2 samples per axis", side);
  check(side <= 1025, {name, "values"}, "have at most 1025 samples per axis", side);
  const Input<std::int32_t> coords({name, "cell_coords"}, cell_coords, {count, 3});
  const MarchingCubesCells cells{coords.data(), field.data(), count, static_cast<int>(side - 1),
                                 static_cast<float>(level)};
  std::vector<std::uint8_t> workspace(marching_cubes_workspace_bytes(kCpu, count, cells.n));
  const MarchingCubesCounts counts = without_gil([&] { return marching_cubes_count(kCpu, cells, workspace.data()); });
  if (counts.faults & kCoordOutOfRange) {
    const auto [low, high] = std::minmax_element(coords.data(), coords.data() + 3 * count);
    refuse_value({name, "cell_coords"}, "be in [-2^20, 2^20 - 1]",
                 std::to_string(*low) + " to " + std::to_string(*high));
  }
  if (counts.faults != 0) refuse_value({name, "cell_coords"}, "be distinct", "a row more than once");
  auto vertices = empty<float>({counts.vertices, 3});
  auto faces = empty<std::int64_t>({counts.faces, 3});
  float* v = vertices.mutable_data();
  std::int64_t* f = faces.mutable_data();
  without_gil([&] { marching_cubes_fill(kCpu, cells, workspace.data(), v, f); });
  return py::make_tuple(vertices, faces);
}

}  // namespace

void define_marching_cubes(py::module_& m) {
  m.def("marching_cubes", &mesh, py::arg("cell_coords"), py::arg("values"), py::arg("level") = 0.0,
        "Welded mesh, vertices float32 [K, 3] in cell units and faces int64 [L, 3], of the level set of values float32 "
        "[M, n + 1, n + 1, n + 1] over the cells at cell_coords int32 [M, 3].");
}

}  // namespace spslam::numpy
