// Host side of the ray kernel.
#include <cmath>
#include <cstdint>
#include <map>
#include <mutex>

#include "core/cuda_check.cuh"
#include "cuda/fused/ray_step.h"
#include "cuda/fused/ray_variants.h"
#include "kernels/interpolation.h"

namespace spslam::fused {
namespace {

__global__ void probe_kernel() {}

struct DeviceFacts {
  int architecture;  // that this library's code for the device was compiled for
  int processors;
};

// Of the current device.
DeviceFacts device_facts() {
  static std::mutex mutex;
  static std::map<int, DeviceFacts> known;
  int device = 0;
  SPS_CUDA_CHECK(cudaGetDevice(&device));
  const std::lock_guard<std::mutex> lock(mutex);
  const auto found = known.find(device);
  if (found != known.end()) return found->second;
  cudaFuncAttributes attributes;
  SPS_CUDA_CHECK(cudaFuncGetAttributes(&attributes, probe_kernel));
  DeviceFacts facts{10 * attributes.ptxVersion, 0};
  SPS_CUDA_CHECK(cudaDeviceGetAttribute(&facts.processors, cudaDevAttrMultiProcessorCount, device));
  return known[device] = facts;
}

RayVariant variant(Precision precision, bool train) {
  const int architecture = device_facts().architecture;
  constexpr int kTensorArchitecture = 800;
  const bool tf32 = precision == Precision::kTf32 && architecture >= kTensorArchitecture;
  if (train) {
    return tf32 ? ray_variant<Precision::kTf32, true>(architecture) : ray_variant<Precision::kFp32, true>(architecture);
  }
  return tf32 ? ray_variant<Precision::kTf32, false>(architecture) : ray_variant<Precision::kFp32, false>(architecture);
}

bool aligned(const void* p) {
  constexpr std::uintptr_t kVectorBytes = 16;
  return reinterpret_cast<std::uintptr_t>(p) % kVectorBytes == 0;
}

bool planes_cover(const TriPlaneLayout& layout) {
  return !empty_plane(layout.planes[0]) && !empty_plane(layout.planes[1]) && !empty_plane(layout.planes[2]);
}

}  // namespace

bool covers(const SceneView& scene, const RenderOptions& options) {
  return options.sampling.num_samples() <= kMaxSamples && aligned(scene.corner_ids) && aligned(scene.embeddings) &&
         aligned(scene.texels);
}

int num_blocks(Precision precision, bool train, std::int64_t num_rays) {
  const int warps = variant(precision, train).warps;
  const std::int64_t groups = (num_rays + warps - 1) / warps, processors = device_facts().processors;
  const std::int64_t rounds = (groups + processors - 1) / processors;
  return rounds > 0 ? static_cast<int>((groups + rounds - 1) / rounds) : 1;
}

RayStepArguments make_arguments(const SceneView& scene, const RaySource& rays, const Intrinsics& camera,
                                const RenderOptions& options) {
  RayStepArguments a{};
  a.scene = scene;
  a.inverse_voxel = 1.0f / scene.voxel_size;
  a.inverse_cell = 1.0f / scene.plane_cell_size;
  a.planes_cover = planes_cover(scene.planes);
  a.rays = rays;
  a.camera = camera;
  a.sampling = options.sampling;
  a.key = options.key;
  const float share = rays.num_rays > 0 ? 1.0f / static_cast<float>(rays.num_rays) : 0.0f;
  const LossWeights& w = options.weights;
  a.scale = {w.rgb * share, w.depth * share, w.free_space * share, w.sdf * share};
  a.cosine_targets = options.cosine_targets;
  a.color = w.rgb != 0.0f;
  a.fixed_point_scale = fixed_point_scale(w);
  return a;
}

float fixed_point_scale(const LossWeights& weights) {
  // With the paper's weights gradients are multiples of 4e-12 and may reach 3e7.
  constexpr int kBits = 47;
  const float largest = std::fmax(std::fmax(weights.rgb, weights.depth), std::fmax(weights.free_space, weights.sdf));
  return std::ldexp(1.0f, kBits - std::ilogb(1.0f + largest));
}

KernelLaunch ray_launch(Precision precision, bool train, const RayStepArguments& arguments) {
  const RayVariant v = variant(precision, train);
  SPS_CUDA_CHECK(cudaFuncSetAttribute(v.kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, v.shared_bytes));
  constexpr int kWarp = 32;
  return {v.kernel, num_blocks(precision, train, arguments.rays.num_rays), v.warps * kWarp, v.shared_bytes, arguments};
}

}  // namespace spslam::fused
