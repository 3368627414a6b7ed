// The scene argument of the fused ops: tensors, scalars and plane layout in three lists.
#pragma once

#include "bindings/common.h"
#include "bindings/plane_layout.h"
#include "spslam/scene_view.h"

namespace spslam::bindings {

// What a schema says for the scene; spslam/ops/scene_view.py fills it.
#define SPS_SCENE_SCHEMA "Tensor[] scene, float[] scene_scalars, int[] plane_layout"

// Keeps the tensors alive while a kernel reads the view.
class SceneArgument {
 public:
  SceneArgument(const std::vector<Tensor>& tensors, const std::vector<double>& scalars,
                const std::vector<std::int64_t>& layout) {
    SPS_CHECK(tensors.size() == 7 && scalars.size() == 6, "spslam: a scene must be 7 tensors and 6 scalars");
    for (const Tensor& tensor : tensors) tensors_.push_back(as_contiguous(tensor));
    const Tensor &keys = tensors_[0], &values = tensors_[1], &corners = tensors_[2], &embeddings = tensors_[3],
                 &geometry = tensors_[4], &texels = tensors_[5], &color = tensors_[6];
    const std::int64_t capacity = keys.numel();
    SPS_CHECK(capacity > 0 && (capacity & (capacity - 1)) == 0 && values.numel() == capacity,
              "spslam: hash_keys and hash_values must have the same power of two of elements");
    view.num_voxels = corners.dim() == 2 ? corners.size(0) : -1;
    SPS_CHECK(has_shape(corners, {-1, kCellCorners}) && has_shape(embeddings, {view.num_voxels, kEmbeddingChannels}),
              "spslam: corner_ids and embeddings must have shapes [V, 8]");
    SPS_CHECK(has_shape(texels, {-1, kPlaneChannels}), "spslam: texels must have shape [P, 32]");
    SPS_CHECK(geometry.numel() == kGeometryDecoder.num_params() && color.numel() == kColorDecoder.num_params(),
              "spslam: decoder parameters of the wrong length");
    view.table = {data<std::int64_t>(keys), data<std::int32_t>(values), capacity - 1};
    view.corner_ids = data<std::int32_t>(corners);
    view.embeddings = data<float>(embeddings);
    view.geometry_params = data<float>(geometry);
    view.texels = data<float>(texels);
    view.color_params = data<float>(color);
    view.voxel_size = static_cast<float>(scalars[0]);
    for (int k = 0; k < 3; ++k) view.origin[k] = static_cast<float>(scalars[1 + k]);
    view.position_scale = static_cast<float>(scalars[4]);
    view.plane_cell_size = static_cast<float>(scalars[5]);
    view.planes = load_plane_layout("spslam", layout, texels.size(0));
  }

  SceneView view;

 private:
  std::vector<Tensor> tensors_;
};

}  // namespace spslam::bindings
