// The plain version: the ops one after the other.
#include "kernels/render_step_launch.h"

namespace spslam {

template <>
std::int64_t render_step_workspace_size(Cuda device, const SceneView& scene, const RayBatch& rays,
                                        const RenderOptions& options) {
  return RenderStepBuffers(device, nullptr, scene, rays, options).bytes;
}

template <>
void render_step(Cuda device, const SceneView& scene, const RayBatch& rays, const RenderOptions& options,
                 const RenderGradients& gradients, void* workspace) {
  const RenderStepBuffers buffers(device, workspace, scene, rays, options);
  RenderStepLaunch<Cuda>(device, scene, rays, options, gradients, buffers).run();
}

}  // namespace spslam
