// The fused step where the ray kernel supports it, else the ops one after the other.
#include "core/for_each.h"
#include "cuda/fused/block_sums.cuh"
#include "cuda/fused/ray_step.h"
#include "launch/render_step.h"

namespace spslam {
namespace {

// Scratch of the fused step.
struct FusedBuffers {
  float *partials, *pose_gradients;
  std::int64_t *embeddings, *texels;  // sums of the tables' gradients
  std::int64_t num_embeddings, num_texels, bytes;

  FusedBuffers(void* base, const SceneView& scene, const RayBatch& rays, const RenderOptions& options,
               const RenderGradients& gradients)
      : num_embeddings(gradients.embeddings ? kEmbeddingChannels * scene.num_voxels : 0),
        num_texels(gradients.texels ? kPlaneChannels * plane_rows(scene.planes) : 0) {
    Workspace memory(base);
    partials = memory.take<float>(std::int64_t{fused::num_blocks(options.precision, true, rays.num_rays)} *
                                  fused::kPartialSize);
    pose_gradients = memory.take<float>(rays.num_rays * fused::kPoseGradientStride);
    embeddings = memory.take<std::int64_t>(num_embeddings);
    texels = memory.take<std::int64_t>(num_texels);
    bytes = memory.used();
  }
};

struct FinishArguments {
  const float *partials, *pose_gradients;
  int blocks;
  RaySource rays;
  LossWeights weights;
  float *losses, *poses, *geometry, *color;
};

// Adds up the partial sums: units of columns, then of frames.
__global__ void __launch_bounds__(fused::kSumThreads) finish_kernel(const __grid_constant__ FinishArguments a) {
  using namespace fused;
  __shared__ float shared[kSumWarps][kWarp];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, unit = blockIdx.x;
  if (unit < kColumnUnits) {
    const int column = unit * kWarp + lane;
    const float sum = sum_column(a.partials + column, kPartialSize, a.blocks, shared);
    constexpr int kGeometryParams = static_cast<int>(kGeometryDecoder.num_params());
    if (warp != 0) return;
    if (column < kGeometryParams) {
      if (a.geometry) a.geometry[column] = sum;
    } else if (column < kNumParams) {
      if (a.color) a.color[column - kGeometryParams] = sum;
    }
    if (unit == kPartialLosses / kWarp) {
      store_losses(sum, kPartialLosses % kWarp, lane, a.weights, a.rays.num_rays, a.losses);
    }
    return;
  }
  const std::int64_t slot = std::int64_t{unit - kColumnUnits} * kSumWarps + warp;
  if (slot >= a.rays.num_slots) return;
  float grad[kPoseGradientSize];
  sum_pose_gradients(a.pose_gradients, a.rays, slot, lane, grad);
  if (lane < kPoseGradientSize) a.poses[kPoseGradientSize * slot + lane] = grad[lane];
}
static_assert(fused::kPartialLosses % fused::kWarp + fused::kLossSums <= fused::kWarp);

// table += sums / scale
void add_sums(Cuda device, std::int64_t count, const std::int64_t* sums, float scale, float* table) {
  const float inverse = 1.0f / scale;
  for_each(device, count, [=] __device__(std::int64_t i) {
    if (sums[i] != 0) table[i] += static_cast<float>(sums[i]) * inverse;
  });
}

void fused_step(Cuda device, const SceneView& scene, const RayBatch& batch, const RenderOptions& options,
                const RenderGradients& out, void* workspace) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const FusedBuffers b(workspace, scene, batch, options, out);
  const RaySource rays{batch.pixels, 0, {}, batch.ray_frames, nullptr, batch.num_rays, batch.num_frames, batch.poses};
  fused::RayStepArguments a = fused::make_arguments(scene, rays, batch.intrinsics, options);
  a.pose = out.poses != nullptr;
  a.geometry_params = out.geometry_params != nullptr;
  a.color_params = a.color && out.color_params;
  a.embeddings = {out.embeddings ? b.embeddings : nullptr, out.embedding_stamps};
  a.texels = {a.color && out.texels ? b.texels : nullptr, out.texel_stamps};
  a.stamp = out.stamp;
  a.partials = b.partials;
  a.pose_gradients = b.pose_gradients;
  if (b.num_embeddings)
    SPS_CUDA_CHECK(cudaMemsetAsync(b.embeddings, 0, b.num_embeddings * sizeof(std::int64_t), stream));
  if (b.num_texels) SPS_CUDA_CHECK(cudaMemsetAsync(b.texels, 0, b.num_texels * sizeof(std::int64_t), stream));
  const KernelLaunch launch = fused::ray_launch(options.precision, true, a);
  const FinishArguments finish{b.partials, b.pose_gradients,    launch.blocks,   rays, options.weights, out.losses,
                               out.poses,  out.geometry_params, out.color_params};
  const std::int64_t pose_units = out.poses ? (batch.num_frames + fused::kSumWarps - 1) / fused::kSumWarps : 0;
  const int units = fused::kColumnUnits + static_cast<int>(pose_units);
  run_launches({launch, {reinterpret_cast<const void*>(&finish_kernel), units, fused::kSumThreads, 0, finish}}, stream);
  add_sums(device, b.num_embeddings, b.embeddings, a.fixed_point_scale, out.embeddings);
  add_sums(device, b.num_texels, b.texels, a.fixed_point_scale, out.texels);
}

}  // namespace

template <>
std::int64_t render_step_workspace_size(Cuda device, const SceneView& scene, const RayBatch& rays,
                                        const RenderOptions& options, const RenderGradients& gradients) {
  if (fused::covers(scene, options)) return FusedBuffers(nullptr, scene, rays, options, gradients).bytes;
  return RenderStepBuffers(device, nullptr, scene, rays, options).bytes;
}

template <>
void render_step(Cuda device, const SceneView& scene, const RayBatch& rays, const RenderOptions& options,
                 const RenderGradients& gradients, void* workspace) {
  if (fused::covers(scene, options)) return fused_step(device, scene, rays, options, gradients, workspace);
  const RenderStepBuffers buffers(device, workspace, scene, rays, options);
  RenderStepLaunch<Cuda>(device, scene, rays, options, gradients, buffers).run();
}

}  // namespace spslam
