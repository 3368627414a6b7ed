#include "spslam/ray_sampling.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

// `out` decides the device and the count: an op without tensor arguments could not be dispatched.
void philox_uniform(std::int64_t seed, std::int64_t stream, std::int64_t frame, std::int64_t iteration, Tensor out) {
  DeviceScope scope(out);
  spslam::philox_uniform(scope.context, philox_key(seed, stream, frame, iteration), out.numel(),
                         mutable_data<float>(out));
}

void sample_indices(std::int64_t seed, std::int64_t stream, std::int64_t frame, std::int64_t iteration,
                    std::int64_t upper, Tensor out) {
  SPS_CHECK(upper >= 1 && upper <= (std::int64_t{1} << 32), "sample_indices: upper must be in [1, 2^32]");
  DeviceScope scope(out);
  spslam::sample_indices(scope.context, philox_key(seed, stream, frame, iteration), upper, out.numel(),
                         mutable_data<std::int64_t>(out));
}

Tensor sample_along_rays(Tensor depth, std::int64_t num_uniform, std::int64_t num_surface, double near, double far,
                         double truncation, std::int64_t seed, std::int64_t stream, std::int64_t frame,
                         std::int64_t iteration) {
  constexpr std::int64_t kMaxSamples = 1 << 20;
  SPS_CHECK(depth.dim() == 1 && num_uniform >= 0 && num_uniform <= kMaxSamples && num_surface >= 0 &&
                num_surface <= kMaxSamples,
            "sample_along_rays: depth must have shape [R] and counts lie in [0, 2^20]");
  SPS_CHECK(depth.numel() == 0 || num_uniform + num_surface <= (std::int64_t{1} << 32) / depth.numel(),
            "sample_along_rays: rays times samples must be at most 2^32");
  DeviceScope scope(depth);
  depth = as_contiguous(depth);
  Tensor out = empty(depth, {depth.numel(), num_uniform + num_surface}, depth.scalar_type());
  dispatch_floating("sample_along_rays", depth, [&](auto zero) {
    using T = decltype(zero);
    const RaySampling<T> sampling{static_cast<std::int32_t>(num_uniform), static_cast<std::int32_t>(num_surface),
                                  static_cast<T>(near), static_cast<T>(far), static_cast<T>(truncation)};
    spslam::sample_along_rays(scope.context, philox_key(seed, stream, frame, iteration), sampling, data<T>(depth),
                              depth.numel(), mutable_data<T>(out));
  });
  return out;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("philox_uniform(int seed, int stream, int frame, int iteration, Tensor(a!) out) -> ()");
  m.def("sample_indices(int seed, int stream, int frame, int iteration, int upper, Tensor(a!) out) -> ()");
  m.def(
      "sample_along_rays(Tensor depth, int num_uniform, int num_surface, float near, float far, float truncation, "
      "int seed, int stream, int frame, int iteration) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("philox_uniform", TORCH_BOX(&philox_uniform));
  m.impl("sample_indices", TORCH_BOX(&sample_indices));
  m.impl("sample_along_rays", TORCH_BOX(&sample_along_rays));
}

}  // namespace spslam::bindings
