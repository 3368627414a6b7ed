#include "spslam/ray_sampling.h"

#include "arrays.h"

namespace spslam::numpy {
namespace {

constexpr std::int64_t kCounterRange = std::int64_t{1} << 32;
constexpr std::int64_t kMaxSamples = 1 << 20;

PhiloxKey checked_key(const char* name, std::int64_t seed, std::int64_t stream, std::int64_t frame,
                      std::int64_t iteration) {
  check(frame >= 0 && frame < kCounterRange, {name, "frame"}, "be in [0, 2^32 - 1]", frame);
  check(iteration >= 0 && iteration < kCounterRange, {name, "iteration"}, "be in [0, 2^32 - 1]", iteration);
  return {static_cast<std::uint64_t>(seed), static_cast<std::uint32_t>(stream), static_cast<std::uint32_t>(frame),
          static_cast<std::uint32_t>(iteration)};
}

py::array_t<float> uniform(std::int64_t seed, std::int64_t stream, std::int64_t frame, std::int64_t iteration,
                           std::int64_t count) {
  const char* name = "philox_uniform";
  check(count >= 0, {name, "count"}, "be at least 0", count);
  const PhiloxKey key = checked_key(name, seed, stream, frame, iteration);
  auto out = empty<float>({count});
  float* numbers = out.mutable_data();
  without_gil([&] { philox_uniform(kCpu, key, count, numbers); });
  return out;
}

py::array_t<std::int64_t> indices(std::int64_t seed, std::int64_t stream, std::int64_t frame, std::int64_t iteration,
                                  std::int64_t count, std::int64_t upper) {
  const char* name = "sample_indices";
  check(count >= 0, {name, "count"}, "be at least 0", count);
  check(upper >= 1 && upper <= kCounterRange, {name, "upper"}, "be in [1, 2^32]", upper);
  const PhiloxKey key = checked_key(name, seed, stream, frame, iteration);
  auto out = empty<std::int64_t>({count});
  std::int64_t* drawn = out.mutable_data();
  without_gil([&] { sample_indices(kCpu, key, upper, count, drawn); });
  return out;
}

py::object along_rays(const py::object& depth, std::int64_t num_uniform, std::int64_t num_surface, double near,
                      double far, double truncation, std::int64_t seed, std::int64_t stream, std::int64_t frame,
                      std::int64_t iteration) {
  const char* name = "sample_along_rays";
  check(num_uniform >= 0 && num_uniform <= kMaxSamples, {name, "num_uniform"}, "be in [0, 2^20]", num_uniform);
  check(num_surface >= 0 && num_surface <= kMaxSamples, {name, "num_surface"}, "be in [0, 2^20]", num_surface);
  check(near >= 0, {name, "near"}, "be at least 0", near);
  check(near <= far, {name, "far"}, "be at least near", far);
  check(truncation >= 0, {name, "truncation"}, "be at least 0", truncation);
  const PhiloxKey key = checked_key(name, seed, stream, frame, iteration);
  return dispatch_floating({name, "depth"}, depth, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Input<T> measured({name, "depth"}, depth, {"R"});
    const std::int64_t rays = measured.size(0), samples = num_uniform + num_surface;
    check(rays * samples <= kCounterRange, {name, "depth"}, "have at most 2^32 / S rays", rays);
    const RaySampling<T> sampling{static_cast<std::int32_t>(num_uniform), static_cast<std::int32_t>(num_surface),
                                  static_cast<T>(near), static_cast<T>(far), static_cast<T>(truncation)};
    auto out = empty<T>({rays, samples});
    T* t = out.mutable_data();
    without_gil([&] { sample_along_rays(kCpu, key, sampling, measured.data(), rays, t); });
    return out;
  });
}

}  // namespace

void define_ray_sampling(py::module_& m) {
  m.def("philox_uniform", &uniform, py::arg("seed"), py::arg("stream"), py::arg("frame"), py::arg("iteration"),
        py::arg("count"),
        "float32 [count] uniform in [0, 1), keyed by the four numbers: no state, the same everywhere.");
  m.def("sample_indices", &indices, py::arg("seed"), py::arg("stream"), py::arg("frame"), py::arg("iteration"),
        py::arg("count"), py::arg("upper"), "int64 [count] uniform in [0, upper), keyed as in philox_uniform.");
  m.def("sample_along_rays", &along_rays, py::arg("depth"), py::arg("num_uniform"), py::arg("num_surface"),
        py::arg("near"), py::arg("far"), py::arg("truncation"), py::arg("seed"), py::arg("stream"), py::arg("frame"),
        py::arg("iteration"),
        "Depths [R, S] (m), ascending, of samples along rays of measured depth [R]: num_uniform stratified between "
        "near and far times it, num_surface within the truncation of it; zeros for rays without depth.");
}

}  // namespace spslam::numpy
