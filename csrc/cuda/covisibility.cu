// One block per frame counts the points that it sees; one block then selects the frames, by ranks among the candidates.
#include "core/for_each.h"
#include "kernels/covisibility.h"

namespace spslam {
namespace {

constexpr int kFrameThreads = 128;
constexpr int kSelectThreads = 1024;
constexpr int kWarp = 32;

// Number of threads of the block before this one for which `flag` holds, and of all of them.
struct Rank {
  int before, total;
};
__device__ Rank rank_in_block(bool flag) {
  __shared__ int counts[kSelectThreads / kWarp];
  const unsigned votes = __ballot_sync(0xffffffffu, flag);
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  if (lane == 0) counts[warp] = __popc(votes);
  __syncthreads();
  Rank rank{__popc(votes & ((1u << lane) - 1u)), 0};
  for (int w = 0; w < kSelectThreads / kWarp; ++w) {
    if (w < warp) rank.before += counts[w];
    rank.total += counts[w];
  }
  __syncthreads();
  return rank;
}

// Every thread of the block returns how many points the frame sees.
template <class Point>
__device__ int count_seen(const FrameThumbnails& frames, std::int64_t frame, const Point& point,
                          std::int64_t num_points) {
  const Pose<double> pose = load_frame_pose(frames.poses + kPoseSize * frame);
  int seen = 0;
  for (std::int64_t first = 0; first < num_points; first += kFrameThreads) {
    const std::int64_t i = first + threadIdx.x;
    seen += __syncthreads_count(i < num_points && sees_point(frames, frame, pose, point(i)));
  }
  return seen;
}

__global__ void overlap_kernel(const float* points, std::int64_t num_points, FrameThumbnails frames, float* share) {
  const auto point = [=](std::int64_t i) { return Vec3<double>{points[3 * i], points[3 * i + 1], points[3 * i + 2]}; };
  const int seen = count_seen(frames, blockIdx.x, point, num_points);
  if (threadIdx.x != 0) return;
  share[blockIdx.x] =
      num_points ? static_cast<float>(static_cast<double>(seen) / static_cast<double>(num_points)) : 0.0f;
}

__global__ void covisible_kernel(const Vec3<double>* points, FrameThumbnails frames, const std::int64_t* candidates,
                                 CovisibleSelection selection, std::uint8_t* covisible) {
  const std::int64_t row = candidates[blockIdx.x];
  int seen = 0;
  if (is_frame(frames, row)) {
    seen = count_seen(frames, row, [=](std::int64_t i) { return points[i]; }, selection.num_points);
  }
  if (threadIdx.x == 0) covisible[blockIdx.x] = is_frame(frames, row) && seen >= covisible_count(selection);
}

// Marks the rows of the candidates that are taken, and writes them in ascending order.
__global__ void __launch_bounds__(kSelectThreads)
    take_kernel(const std::uint8_t* covisible, const std::int64_t* candidates, std::int64_t num_candidates,
                FrameThumbnails frames, CovisibleSelection selection, std::uint8_t* marks, std::int64_t* selected) {
  std::int64_t num_covisible = 0;
  for (std::int64_t first = 0; first < num_candidates; first += kSelectThreads) {
    const std::int64_t i = first + threadIdx.x;
    num_covisible += __syncthreads_count(i < num_candidates && covisible[i]);
  }
  for (std::int64_t f = threadIdx.x; f < frames.num_frames; f += kSelectThreads) marks[f] = 0;
  __syncthreads();
  const std::int64_t wanted = selection.num_covisible < selection.count ? selection.num_covisible : selection.count;
  const std::int64_t num_others = selection.count - (num_covisible < wanted ? num_covisible : wanted);
  std::int64_t passed = 0;  // co-visible candidates before this round
  for (std::int64_t first = 0; first < num_candidates; first += kSelectThreads) {
    const std::int64_t i = first + threadIdx.x;
    const bool sees = i < num_candidates && covisible[i];
    const Rank rank = rank_in_block(sees);
    const std::int64_t before = passed + rank.before;
    const bool other = i - (before < wanted ? before : wanted) < num_others;
    const bool taken = i < num_candidates && ((sees && before < wanted) || other);
    if (taken && is_frame(frames, candidates[i])) marks[candidates[i]] = 1;
    passed += rank.total;
  }
  __syncthreads();
  std::int64_t written = 0;
  for (std::int64_t first = 0; first < frames.num_frames; first += kSelectThreads) {
    const std::int64_t f = first + threadIdx.x;
    const bool taken = f < frames.num_frames && marks[f];
    const Rank rank = rank_in_block(taken);
    if (taken) selected[written + rank.before] = f;
    written += rank.total;
  }
  for (std::int64_t i = written + threadIdx.x; i < selection.count; i += kSelectThreads) selected[i] = -1;
}

}  // namespace

template <>
void frame_overlap<Cuda>(Cuda device, const float* points, std::int64_t num_points, const FrameThumbnails& frames,
                         float* share) {
  if (frames.num_frames == 0) return;
  overlap_kernel<<<static_cast<unsigned>(frames.num_frames), kFrameThreads, 0,
                   static_cast<cudaStream_t>(device.stream)>>>(points, num_points, frames, share);
}

template <>
std::int64_t covisible_workspace_size<Cuda>(Cuda, const FrameThumbnails& frames, std::int64_t num_candidates,
                                            const CovisibleSelection& selection) {
  return selection.num_points * static_cast<std::int64_t>(sizeof(Vec3<double>)) + num_candidates + frames.num_frames;
}

template <>
void select_covisible_frames<Cuda>(Cuda device, const std::int32_t* records, std::int64_t num_records,
                                   const FrameThumbnails& frames, const std::int64_t* candidates,
                                   std::int64_t num_candidates, const CovisibleSelection& selection, void* workspace,
                                   std::int64_t* selected) {
  if (num_candidates == 0) return;
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  Vec3<double>* points = static_cast<Vec3<double>*>(workspace);
  std::uint8_t* covisible = reinterpret_cast<std::uint8_t*>(points + selection.num_points);
  for_each(device, selection.num_points, [=] __device__(std::int64_t i) {
    const std::int64_t at = philox_index(selection.key, static_cast<std::uint32_t>(i), num_records);
    points[i] = pixel_point(records + kPixelWords * at, load_frame_pose(frames.poses + kPoseSize * selection.current),
                            frames.intrinsics);
  });
  covisible_kernel<<<static_cast<unsigned>(num_candidates), kFrameThreads, 0, stream>>>(points, frames, candidates,
                                                                                        selection, covisible);
  take_kernel<<<1, kSelectThreads, 0, stream>>>(covisible, candidates, num_candidates, frames, selection,
                                                covisible + num_candidates, selected);
}

}  // namespace spslam
