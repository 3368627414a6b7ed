#include "launch/marching_cubes.h"

namespace spslam {
namespace {

// Turns counts into the running sum before each; the total is the entry past the last.
void exclusive_sum(std::int64_t count, std::int64_t* values) {
  std::int64_t sum = 0;
  for (std::int64_t i = 0; i < count; ++i) {
    const std::int64_t value = values[i];
    values[i] = sum;
    sum += value;
  }
  values[count] = sum;
}

}  // namespace

template <>
MarchingCubesCounts marching_cubes_count<Cpu>(Cpu device, const MarchingCubesCells& cells, void* workspace) {
  const MarchingCubesWork work = marching_cubes_layout(cells, workspace);
  marching_cubes_mark(device, cells, work);
  exclusive_sum(cells.count, work.vertex_offsets);
  exclusive_sum(cells.count, work.face_offsets);
  return {work.vertex_offsets[cells.count], work.face_offsets[cells.count], *work.faults};
}

SPS_INSTANTIATE_MARCHING_CUBES(Cpu)

}  // namespace spslam
