// Tracking is one kernel for all iterations: each block sums its pixels' shares of the normal equations, waits for the
// others at a grid-wide barrier, and then computes the step redundantly, so that one barrier per iteration is enough.
#include <cooperative_groups.h>

#include <algorithm>

#include "core/cuda_check.cuh"
#include "core/for_each.h"
#include "cuda/geometry_fragments.cuh"
#include "cuda/warp_sums.cuh"
#include "kernels/gauss_newton.h"
#include "kernels/voxel_hash.h"

namespace spslam {
namespace {

constexpr int kWarps = 4;
constexpr int kThreads = kWarps * kWarp;
constexpr int kBlockPixels = kWarps * fused::kTileRows;
// A grid-wide barrier needs all blocks to be resident: few enough for the smallest device.
constexpr std::int64_t kMaxTrackingBlocks = 16;
constexpr int kPaddedTerms = kWarp;  // kTrackingTerms or kKeyframeTerms, one per lane
static_assert(kTrackingTerms <= kPaddedTerms && kKeyframeTerms <= kPaddedTerms && kAllGainTerms <= kPaddedTerms,
              "one lane per term");
constexpr int kSets = 3;  // of terms: the map's, the depth keyframes', the gain's
constexpr int kSums = kSets * kPaddedTerms;
static_assert(kSums <= kThreads, "one thread per sum");

// A lane's terms.
struct LaneTerms {
  float map[kPaddedTerms] = {}, keyframes[kPaddedTerms] = {}, gain[kPaddedTerms] = {};
};

std::int64_t block_count(std::int64_t pixels) {
  return (pixels + kBlockPixels - 1) / kBlockPixels;
}

std::int64_t tracking_block_count(std::int64_t pixels) {
  return std::min(block_count(pixels), kMaxTrackingBlocks);
}

// The record of pixel i of frame f: drawn by Philox while tracking, the i-th of the frame otherwise.
struct PixelSource {
  const std::int32_t* pixels;
  std::int64_t num_records, pixels_per_frame;
  bool drawn;
  PhiloxKey key;

  // Of depth 0 past the frame's pixels.
  __device__ Pixel load(std::int64_t frame, std::int64_t i) const {
    if (i >= pixels_per_frame) return {};
    const std::int64_t at =
        drawn ? philox_index(key, static_cast<std::uint32_t>(i), num_records) : frame * pixels_per_frame + i;
    return unpack_pixel(pixels + kPixelWords * at);
  }
};

// Adds the share of a tile of pixels, one per lane, to the lane's terms.
template <Precision kPrecision>
__device__ __forceinline__ void add_pixel_tile(const SceneView& scene, const GeometryNetwork<kPrecision>& network,
                                               const Measurement& measure, const Pose<float>& pose, const Pixel& pixel,
                                               int lane, LaneTerms& terms) {
  const GaussNewtonOptions& options = *measure.options;
  const SurfacePoint point = surface_point(pixel, pose, options.intrinsics);
  std::int32_t voxel = kNoVoxel;
  Cell<float> cell{nullptr, {0.0f, 0.0f, 0.0f}};
  if (pixel.depth > 0.0f) {
    cell = find_cell(scene.table, scene.corner_ids, scene.num_voxels, (1.0f / scene.voxel_size) * point.world);
    if (cell.corner_ids) voxel = static_cast<std::int32_t>((cell.corner_ids - scene.corner_ids) / kCellCorners);
  }
  Vec3<float> gradient;
  const float sdf = geometry_tile(scene, network, point.world, cell.local, voxel, lane, gradient);
  // Two lanes hold the same pixel: one adds its residuals against the map and the reference, and they share the depth
  // keyframes.
  const bool adds = lane % 4 < 2, known = is_tracking_inlier(pixel.depth, voxel != kNoVoxel, sdf);
  const PixelNoise noise = noise_of(measure, pixel);
  if (pixel.depth > 0.0f) {
    add_keyframe_residuals(measure, pixel, point, noise, {sdf * options.truncation, known}, lane % 4 / 2, 2,
                           terms.keyframes, terms.gain + kGainTerms);
  }
  if (adds && known) add_map_residual(measure, point.offset, sdf, gradient, noise.map_certainty, terms.map);
  if (adds) add_reference_residual(measure, pixel, point, terms.map, terms.gain);
}

// The pixels of one thread in the order in which it takes them: tile after tile of this block, then those of the next
// iteration. Each is prefetched while the one before is worked on.
class PixelQueue {
 public:
  __device__ PixelQueue(const PixelSource& source, std::int64_t frame)
      : source_(source),
        frame_(frame),
        own_(blockIdx.x * kBlockPixels + threadIdx.x / kWarp * fused::kTileRows + lane_sample(threadIdx.x % kWarp)),
        at_(own_),
        next_(source.load(frame, own_)) {}

  // Whether the block still has pixels in this iteration; if not, the next iteration begins.
  __device__ bool pop(Pixel& pixel) {
    if (at_ - own_ + blockIdx.x * kBlockPixels >= source_.pixels_per_frame) {
      at_ = own_;
      return false;
    }
    pixel = next_;
    at_ += static_cast<std::int64_t>(gridDim.x) * kBlockPixels;
    if (at_ - own_ + blockIdx.x * kBlockPixels < source_.pixels_per_frame) {
      next_ = source_.load(frame_, at_);
    } else {
      ++source_.key.iteration;
      next_ = source_.drawn ? source_.load(frame_, own_) : Pixel{};
    }
    return true;
  }

 private:
  PixelSource source_;
  std::int64_t frame_, own_, at_;
  Pixel next_;
};

// Sums over the pixels of a frame that this block takes: thread t < kSums returns term t % 32 of set t / 32.
template <Precision kPrecision>
__device__ __forceinline__ double sum_block(const SceneView& scene, const GeometryNetwork<kPrecision>& network,
                                            const Measurement& measure, const Pose<float>& pose, PixelQueue& queue,
                                            float (&sums)[kWarps][kSums]) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  LaneTerms terms;
  for (Pixel pixel; queue.pop(pixel);) add_pixel_tile(scene, network, measure, pose, pixel, lane, terms);
  sums[warp][lane] = transpose_sum(terms.map, lane);
  sums[warp][kPaddedTerms + lane] = transpose_sum(terms.keyframes, lane);
  sums[warp][2 * kPaddedTerms + lane] = transpose_sum(terms.gain, lane);
  __syncthreads();
  double sum = 0.0;
  if (threadIdx.x < kSums) {
    for (int w = 0; w < kWarps; ++w) sum += static_cast<double>(sums[w][threadIdx.x]);
  }
  return sum;
}

// terms[t] = sum over blocks of partials[block][t], t < kSums.
__device__ void add_partials(const double* partials, std::int64_t blocks, double* terms) {
  if (threadIdx.x < kSums) {
    double sum = 0.0;
#pragma unroll 8
    for (std::int64_t b = 0; b < blocks; ++b) sum += __ldcg(partials + b * kSums + threadIdx.x);
    terms[threadIdx.x] = sum;
  }
  __syncthreads();
}

// __grid_constant__: threads read the options and the scene in the parameters themselves, without copies. The 1: with
// so few blocks, registers are worth more than a second block per multiprocessor.
template <Precision kPrecision>
__global__ void __launch_bounds__(kThreads, 1)
    track_kernel(const __grid_constant__ SceneView scene, const std::int32_t* pixels, std::int64_t num_records,
                 const __grid_constant__ GaussNewtonOptions options, double* partials, float* pose, float* stats,
                 float* hessian) {
  if (options.wanted && *options.wanted != 1.0f) return;  // all blocks alike: none waits for another
  // Devices without tensor cores for tf32 compute in float32.
  constexpr Precision kUsed = fused::kArchitecture < fused::kTensorArchitecture ? Precision::kFp32 : kPrecision;
  __shared__ GeometryNetwork<kUsed> network;
  __shared__ float sums[kWarps][kSums];
  __shared__ double terms[kSums], joint[kJointNormals];
  __shared__ EarlierFrames frames;
  __shared__ float own_pose[kPoseSize], own_stats[kFrameStatSize], own_hessian[36];
  network.load(scene.geometry_params);
  if (threadIdx.x < kPoseSize) own_pose[threadIdx.x] = pose[threadIdx.x];
  if (threadIdx.x < kMaxEarlierFrames) load_earlier_frame(options, threadIdx.x, frames);
  const PhiloxKey key{options.key.seed, options.key.stream, options.key.frame, 0};
  PixelQueue queue({pixels, num_records, options.num_pixels, true, key}, 0);
  __syncthreads();
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    const Measurement measure = measurement(options, &frames, iteration);
    if (threadIdx.x == 0) load_colors(options, own_pose, frames);
    __syncthreads();
    const double sum = sum_block(scene, network, measure, load_pose(own_pose), queue, sums);
    // Two sets in turn: a block may be an iteration ahead of one that still reads.
    double* shared_sums = partials + (iteration % 2) * gridDim.x * kSums;
    if (threadIdx.x < kSums) __stcg(shared_sums + blockIdx.x * kSums + threadIdx.x, sum);
    cooperative_groups::this_grid().sync();
    add_partials(shared_sums, gridDim.x, terms);
    if (threadIdx.x == 0) {
      join_keyframe_terms(terms, terms + kPaddedTerms, terms + 2 * kPaddedTerms, measure.num_keyframes, joint);
      FrameGain* gain = options.depth_keyframes.log_gains ? &frames.gain : nullptr;
      own_stats[kTrackingStatSize + 1] = gain ? gain_variance(joint, *gain) : 0.0f;
      tracking_step(terms, joint, options.damping, held_damping(measure, terms), own_pose, own_stats + 2, own_hessian,
                    gain);
      own_stats[kTrackingStatSize] = gain ? gain->log_gain : 0.0f;
    }
    if (threadIdx.x == kWarp) tracking_fit(terms, options.num_pixels, own_stats);
    __syncthreads();
    if (blockIdx.x == 0 && threadIdx.x < kFrameStatSize) {
      stats[iteration * kFrameStatSize + threadIdx.x] = own_stats[threadIdx.x];
    }
  }
  if (blockIdx.x != 0) return;
  if (threadIdx.x < kPoseSize) pose[threadIdx.x] = own_pose[threadIdx.x];
  if (threadIdx.x < 36) hessian[threadIdx.x] = own_hessian[threadIdx.x];
}

// partials[frame][block][term] of given pixels.
__global__ void __launch_bounds__(kThreads)
    residual_kernel(const __grid_constant__ SceneView scene, PixelSource source, const float* poses,
                    const __grid_constant__ GaussNewtonOptions options, double* partials) {
  __shared__ GeometryNetwork<Precision::kFp32> network;
  __shared__ float sums[kWarps][kSums];
  network.load(scene.geometry_params);
  __syncthreads();
  const std::int64_t frame = blockIdx.y;
  PixelQueue queue(source, frame);
  const double sum =
      sum_block(scene, network, measurement(options, nullptr, 0), load_pose(poses + kPoseSize * frame), queue, sums);
  if (threadIdx.x < kSums) partials[(frame * gridDim.x + blockIdx.x) * kSums + threadIdx.x] = sum;
}

__global__ void __launch_bounds__(kThreads)
    store_kernel(const double* partials, std::int64_t blocks, std::int64_t num_pixels, PoseEquations out) {
  __shared__ double terms[kSums];
  add_partials(partials + blockIdx.x * blocks * kSums, blocks, terms);
  if (threadIdx.x == 0) store_pose_equations(terms, blockIdx.x, num_pixels, out);
}

}  // namespace

template <>
void predict_pose<Cuda>(Cuda device, const RecentMotion& recent, float* next) {
  const RecentMotion motion = recent;
  for_each(device, 1, [=] __device__(std::int64_t) { constant_speed_pose(motion, next); });
}

template <>
std::int64_t gauss_newton_workspace_size<Cuda>(Cuda, std::int64_t frames, std::int64_t pixels) {
  const std::int64_t sets = std::max<std::int64_t>(frames * block_count(pixels), 2 * tracking_block_count(pixels));
  return std::max<std::int64_t>(sets, 1) * kSums * static_cast<std::int64_t>(sizeof(double));
}

template <>
void track_gauss_newton<Cuda>(Cuda device, const SceneView& scene, const std::int32_t* pixels, std::int64_t num_records,
                              const GaussNewtonOptions& options, void* workspace, float* pose, float* stats,
                              float* hessian) {
  double* partials = static_cast<double*>(workspace);
  void* arguments[] = {const_cast<SceneView*>(&scene),
                       &pixels,
                       &num_records,
                       const_cast<GaussNewtonOptions*>(&options),
                       &partials,
                       &pose,
                       &stats,
                       &hessian};
  const auto kernel = options.tf32 ? track_kernel<Precision::kTf32> : track_kernel<Precision::kFp32>;
  SPS_CUDA_CHECK(cudaLaunchCooperativeKernel(reinterpret_cast<const void*>(kernel),
                                             dim3(static_cast<unsigned>(tracking_block_count(options.num_pixels))),
                                             dim3(kThreads), arguments, 0, static_cast<cudaStream_t>(device.stream)));
}

template <>
void gauss_newton_poses<Cuda>(Cuda device, const SceneView& scene, const std::int32_t* pixels, const float* poses,
                              std::int64_t frames, std::int64_t pixels_per_frame, const Intrinsics& intrinsics,
                              float truncation, float kernel, void* workspace, const PoseEquations& out) {
  if (frames == 0) return;
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  double* partials = static_cast<double*>(workspace);
  const std::int64_t blocks = block_count(pixels_per_frame);
  const PixelSource source{pixels, frames * pixels_per_frame, pixels_per_frame, false, {}};
  if (blocks > 0) {
    const dim3 grid(static_cast<unsigned>(blocks), static_cast<unsigned>(frames));
    residual_kernel<<<grid, kThreads, 0, stream>>>(scene, source, poses, map_options(intrinsics, truncation, kernel),
                                                   partials);
  }
  store_kernel<<<static_cast<unsigned>(frames), kThreads, 0, stream>>>(partials, blocks, pixels_per_frame, out);
}

}  // namespace spslam
