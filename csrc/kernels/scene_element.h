// The scene at one point, evaluated by one thread without tiles of samples.
#pragma once

#include <cstdint>

#include "kernels/decoders.h"
#include "kernels/interpolation.h"
#include "kernels/voxel_hash.h"
#include "spslam/scene_view.h"

namespace spslam {

// out[o] = relu(bias[o] + W[o] . x) of a layer with `inputs` inputs at params = W, bias; returns where the next one
// lies.
template <std::int64_t kOutputs>
SPS_INLINE const float* element_layer(const float* params, const float* x, std::int64_t inputs, bool rectify,
                                      float* out) {
  const float* bias = params + kOutputs * inputs;
  for (std::int64_t o = 0; o < kOutputs; ++o) {
    const float y = unit(params + o * inputs, x, inputs, bias[o]);
    out[o] = rectify ? rectified(y) : y;
  }
  return bias + kOutputs;
}

// Decoder input at a point in a complete cell.
SPS_INLINE void geometry_input(const SceneView& scene, const Vec3<float>& point, const Cell<float>& cell, float* x) {
  x[0] = (point.x - scene.origin[0]) * scene.position_scale;
  x[1] = (point.y - scene.origin[1]) * scene.position_scale;
  x[2] = (point.z - scene.origin[2]) * scene.position_scale;
  for (int c = 0; c < kEmbeddingChannels; ++c) x[3 + c] = 0.0f;
  for (int k = 0; k < kCellCorners; ++k) {
    const float weight = trilinear_weight(cell.local, k);
    const float* row = scene.embeddings + kEmbeddingChannels * static_cast<std::int64_t>(cell.corner_ids[k]);
    for (int c = 0; c < kEmbeddingChannels; ++c) x[3 + c] += weight * row[c];
  }
}

// SDF / truncation at a point in a complete cell; gradient (1/m) too where it is not null.
SPS_INLINE float geometry_element(const SceneView& scene, const Vec3<float>& point, const Cell<float>& cell,
                                  Vec3<float>* gradient) {
  constexpr std::int64_t kInputs = kGeometryDecoder.input, kHidden = kDecoderHidden;
  float x[kInputs], h1[kHidden], h2[kHidden], y;
  geometry_input(scene, point, cell, x);
  const float* layer2 = element_layer<kHidden>(scene.geometry_params, x, kInputs, true, h1);
  const float* layer3 = element_layer<kHidden>(layer2, h1, kHidden, true, h2);
  element_layer<1>(layer3, h2, kHidden, false, &y);
  const float sdf = activate(MlpActivation::kTanh, y);
  if (!gradient) return sdf;

  const float slope = activation_slope(MlpActivation::kTanh, sdf);
  float g1[kHidden], gx[kInputs], corner[kCellCorners];
  for (std::int64_t i = 0; i < kHidden; ++i) h2[i] = rectified_gradient(h2[i], slope * layer3[i]);
  for (std::int64_t i = 0; i < kHidden; ++i) {
    g1[i] = rectified_gradient(h1[i], input_gradient(h2, layer2 + i, kHidden, kHidden));
  }
  for (std::int64_t i = 0; i < kInputs; ++i) gx[i] = input_gradient(g1, scene.geometry_params + i, kHidden, kInputs);
  for (int k = 0; k < kCellCorners; ++k) {
    corner[k] = unit(gx + 3, scene.embeddings + kEmbeddingChannels * static_cast<std::int64_t>(cell.corner_ids[k]),
                     kEmbeddingChannels, 0.0f);
  }
  *gradient = scene.position_scale * Vec3<float>{gx[0], gx[1], gx[2]} +
              (1.0f / scene.voxel_size) * trilinear_gradient(cell.local, corner);
  return sdf;
}

// RGB at a point.
SPS_INLINE void color_element(const SceneView& scene, const Vec3<float>& point, float* color) {
  float x[kPlaneChannels] = {}, h1[kDecoderHidden], h2[kDecoderHidden];
  const float inverse_cell = 1.0f / scene.plane_cell_size;
  for (int plane = 0; plane < 3; ++plane) {
    if (empty_plane(scene.planes.planes[plane])) continue;
    const PlaneCell<float> cell = tri_plane_cell(point, inverse_cell, scene.planes.planes[plane], plane);
    for (int k = 0; k < 4; ++k) {
      const float* row = scene.texels + kPlaneChannels * cell.rows[k];
      for (int c = 0; c < kPlaneChannels; ++c) x[c] += cell.weights[k] * row[c];
    }
  }
  const float* layer2 = element_layer<kDecoderHidden>(scene.color_params, x, kPlaneChannels, true, h1);
  const float* layer3 = element_layer<kDecoderHidden>(layer2, h1, kDecoderHidden, true, h2);
  element_layer<3>(layer3, h2, kDecoderHidden, false, color);
  for (int k = 0; k < 3; ++k) color[k] = activate(MlpActivation::kSigmoid, color[k]);
}

}  // namespace spslam
