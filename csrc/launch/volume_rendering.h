// What the launches of volume_rendering share: the targets of one ray, and the instantiations.
#pragma once

#include "kernels/volume_rendering_ray.h"
#include "spslam/volume_rendering.h"

namespace spslam {

template <class T>
SPS_INLINE RayTarget<T> ray_target(const LossInputs<T>& inputs, std::int64_t r) {
  return {inputs.target_color + 3 * r, inputs.target_depth[r], target_cosine(inputs.cosine[r], inputs.cosine_targets),
          inputs.rendered[r]};
}

#define SPS_INSTANTIATE_VOLUME_RENDERING(Device, T)                                                                 \
  template void volume_render<Device, T>(Device, const SampleTable<T>&, const T*, T, T*, T*, T*);                   \
  template void volume_render_backward<Device, T>(Device, const SampleTable<T>&, const T*, const T*, T, const T*,   \
                                                  const T*, const T*, T*, T*, T*);                                  \
  template void rendering_losses<Device, T>(Device, const SampleTable<T>&, const LossInputs<T>&, T*, T*);           \
  template void rendering_losses_backward<Device, T>(Device, const SampleTable<T>&, const LossInputs<T>&, const T*, \
                                                     T*, T*, T*, T*);

}  // namespace spslam
