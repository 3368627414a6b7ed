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
  STD_TORCH_CHECK(upper >= 1 && upper <= (std::int64_t{1} << 32), "sample_indices: upper must be in [1, 2^32]");
  DeviceScope scope(out);
  spslam::sample_indices(scope.context, philox_key(seed, stream, frame, iteration), upper, out.numel(),
                         mutable_data<std::int64_t>(out));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("philox_uniform(int seed, int stream, int frame, int iteration, Tensor(a!) out) -> ()");
  m.def("sample_indices(int seed, int stream, int frame, int iteration, int upper, Tensor(a!) out) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("philox_uniform", TORCH_BOX(&philox_uniform));
  m.impl("sample_indices", TORCH_BOX(&sample_indices));
}

}  // namespace spslam::bindings
