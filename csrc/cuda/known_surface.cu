// One block per row compares its points; a second pass counts what is hidden once all marks are known; one block
// selects.
#include "core/for_each.h"
#include "kernels/known_surface.h"

namespace spslam {
namespace {

constexpr int kRowThreads = 128;
constexpr int kSelectThreads = 256;

__global__ void compare_kernel(FrameThumbnails frames, ComparedFrame frame, SurfaceTolerance tolerance,
                               const std::int64_t* rows, KnownSurfaceSpace space) {
  const std::int64_t i = blockIdx.x, row = rows[i];
  const bool is_known = is_frame(frames, row);
  const Pose<double> own = load_frame_pose(frame.pose);
  const Pose<double> pose = is_known ? load_frame_pose(frames.poses + kPoseSize * row) : own;
  std::int32_t seen = 0, through = 0;
  for (std::int64_t begin = 0; begin < space.num_points; begin += kRowThreads) {
    const std::int64_t place = begin + threadIdx.x;
    ComparedPoint point{kSurfaceCounts, 0};
    if (is_known && place < space.num_points) {
      point = compared_point(frames, row, pose, place, frame, own, space.first, tolerance);
    }
    if (place < space.num_points) space.hidden[space.num_points * i + place] = point.kind == kHidden ? point.cell : -1;
    if (point.kind == kSeen) space.marks[point.cell] = 1;  // several threads may write the same
    seen += __syncthreads_count(point.kind == kSeen);
    through += __syncthreads_count(point.kind == kThrough);
  }
  if (threadIdx.x != 0) return;
  space.counts[kSurfaceCounts * i + kSeen] = seen;
  space.counts[kSurfaceCounts * i + kThrough] = through;
}

__global__ void hidden_kernel(ComparedFrame frame, KnownSurfaceSpace space) {
  std::int32_t count = 0;
  for (std::int64_t begin = 0; begin < space.num_points; begin += kRowThreads) {
    const std::int64_t place = begin + threadIdx.x;
    const std::int32_t cell = place < space.num_points ? space.hidden[space.num_points * blockIdx.x + place] : -1;
    count += __syncthreads_count(cell >= 0 && !is_marked_near(frame, space.marks, cell));
  }
  if (threadIdx.x == 0) space.counts[kSurfaceCounts * blockIdx.x + kHidden] = count;
}

__global__ void select_kernel(KnownSurfaceSpace space, std::int64_t num_rows, std::int64_t num_best,
                              std::int64_t* counts, std::int64_t* best) {
  __shared__ unsigned long long sums[kSurfaceCounts];
  if (threadIdx.x < kSurfaceCounts) sums[threadIdx.x] = 0;
  __syncthreads();
  for (std::int64_t i = threadIdx.x; i < num_rows; i += kSelectThreads) {
    const std::int64_t rank = rank_of(space.counts, i, num_rows);
    if (rank >= num_best) continue;
    best[rank] = i;
    for (int kind = 0; kind < kSurfaceCounts; ++kind)
      atomicAdd(sums + kind, static_cast<unsigned long long>(space.counts[kSurfaceCounts * i + kind]));
  }
  __syncthreads();
  if (threadIdx.x < kSurfaceCounts) counts[threadIdx.x] = static_cast<std::int64_t>(sums[threadIdx.x]);
}

}  // namespace

template <>
std::int64_t known_surface_workspace_size<Cuda>(Cuda, const FrameThumbnails& frames, const ComparedFrame& frame,
                                                std::int64_t num_rows) {
  return KnownSurfaceSpace::size(frames, frame, num_rows);
}

template <>
void count_known_surface<Cuda>(Cuda device, const FrameThumbnails& frames, const ComparedFrame& frame,
                               const SurfaceTolerance& tolerance, const std::int64_t* rows, std::int64_t num_rows,
                               std::int64_t num_best, void* workspace, std::int64_t* counts, std::int64_t* best) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const KnownSurfaceSpace space(workspace, frames, frame, num_rows);
  for_each(device, space.num_cells, [=] __device__(std::int64_t cell) {
    space.first[cell] = kNoRecord;
    space.marks[cell] = 0;
  });
  for_each(device, frame.num_records, [=] __device__(std::int64_t i) {
    const std::int32_t cell = cell_of(frame, frame.records + kPixelWords * i);
    if (cell >= 0 && has_normal(frame.normals + 3 * i)) atomicMin(space.first + cell, static_cast<std::int32_t>(i));
  });
  if (num_rows > 0) {
    const unsigned blocks = static_cast<unsigned>(num_rows);
    compare_kernel<<<blocks, kRowThreads, 0, stream>>>(frames, frame, tolerance, rows, space);
    hidden_kernel<<<blocks, kRowThreads, 0, stream>>>(frame, space);
  }
  select_kernel<<<1, kSelectThreads, 0, stream>>>(space, num_rows, num_best, counts, best);
}

}  // namespace spslam
