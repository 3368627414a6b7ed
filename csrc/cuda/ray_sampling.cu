#include "kernels/ray_sampling.h"
#include "launch/ray_sampling.h"

namespace spslam {

template <class Device, class T>
void sample_along_rays(Device device, PhiloxKey key, const RaySampling<T>& sampling, const T* depth,
                       std::int64_t num_rays, T* out) {
  const RaySampling<T> copy = sampling;  // a lambda for the device must not hold a reference
  for_each(device, num_rays,
           [=] __device__(std::int64_t r) { sample_ray(key, copy, r, depth[r], out + r * copy.num_samples()); });
}

SPS_INSTANTIATE_RAY_SAMPLING(Cuda)
}  // namespace spslam
