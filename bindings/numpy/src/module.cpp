#include "arrays.h"
#include "spslam/core/parallel.h"

namespace {

namespace py = pybind11;

void set_num_threads(std::int64_t count) {
  constexpr std::int64_t kMaxThreads = 4096;
  spslam::numpy::check(count >= 1, {"set_num_threads", "count"}, "be at least 1", count);
  spslam::numpy::check(count <= kMaxThreads, {"set_num_threads", "count"}, "be at most 4096", count);
  spslam::set_num_threads(static_cast<int>(count));
}

}  // namespace

PYBIND11_MODULE(SPSLAM_MODULE, m) {
  m.def("set_num_threads", &set_num_threads, py::arg("count"),
        "Lets the kernels use `count` threads, the calling one included. Results do not depend on it. Not to be called "
        "while another thread runs a kernel.");
  m.def("get_num_threads", &spslam::get_num_threads,
        "Threads the kernels may use; at first as many as there are cores.");
  spslam::numpy::define_voxel_hash(m);
  spslam::numpy::define_interpolation(m);
  spslam::numpy::define_ray_sampling(m);
  spslam::numpy::define_volume_rendering(m);
  spslam::numpy::define_decoders(m);
  spslam::numpy::define_optimizer(m);
  spslam::numpy::define_prior_fusion(m);
  spslam::numpy::define_marching_cubes(m);
}
