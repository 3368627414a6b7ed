// What has no tensor: the thread count of the CPU kernels and a constant of tracking, implemented for every backend at
// once, and the architectures that the CUDA library was built for.
#ifdef SPS_CUDA
// Read from the file by `spslam doctor`, also where the library cannot be loaded.
extern "C" __attribute__((used)) const char spslam_cuda_archs[] = "spslam-cuda-archs=" SPSLAM_CUDA_ARCHS;
#else
#include "bindings/common.h"
#include "core/parallel.h"
#include "spslam/types/luma.h"

namespace spslam::bindings {
namespace {

void set_num_threads_op(std::int64_t count) {
  constexpr std::int64_t kMaxThreads = 4096;
  SPS_CHECK(count >= 1 && count <= kMaxThreads, "set_num_threads: count must be in [1, ", kMaxThreads, "], got ",
            count);
  spslam::set_num_threads(static_cast<int>(count));
}

std::int64_t get_num_threads_op() {
  return spslam::get_num_threads();
}

std::tuple<std::int64_t, std::int64_t, std::int64_t> luma_weights_op() {
  return {kLumaWeights[0], kLumaWeights[1], kLumaWeights[2]};
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("set_num_threads(int count) -> ()");
  m.def("get_num_threads() -> int");
  m.def("luma_weights() -> (int, int, int)");
}

STABLE_TORCH_LIBRARY_IMPL(spslam, CompositeExplicitAutograd, m) {
  m.impl("set_num_threads", TORCH_BOX(&set_num_threads_op));
  m.impl("get_num_threads", TORCH_BOX(&get_num_threads_op));
  m.impl("luma_weights", TORCH_BOX(&luma_weights_op));
}

}  // namespace spslam::bindings
#endif
