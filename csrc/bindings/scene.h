// The scene argument of the fused ops: tensors, scalars and plane layout in three lists.
#pragma once

#include "bindings/common.h"
#include "spslam/scene_view.h"

namespace spslam::bindings {

// What a schema says for the scene; spslam/ops/scene_view.py fills it.
#define SPS_SCENE_SCHEMA "Tensor[] scene, float[] scene_scalars, int[] plane_layout"

// Keeps the tensors alive while a kernel reads the view.
class SceneArgument {
 public:
  SceneArgument(const std::vector<Tensor>& tensors, const std::vector<double>& scalars,
                const std::vector<std::int64_t>& layout) {
    SPS_CHECK(tensors.size() == 7 && scalars.size() == 6 && layout.size() == 15,
              "spslam: a scene must be 7 tensors, 6 scalars and 15 integers");
    for (const Tensor& tensor : tensors) tensors_.push_back(torch::stable::contiguous(tensor));
    const Tensor &keys = tensors_[0], &values = tensors_[1], &corners = tensors_[2], &embeddings = tensors_[3],
                 &geometry = tensors_[4], &texels = tensors_[5], &color = tensors_[6];
    const std::int64_t capacity = keys.numel();
    SPS_CHECK(capacity > 0 && (capacity & (capacity - 1)) == 0 && values.numel() == capacity,
              "spslam: hash_keys and hash_values must have the same power of two of elements");
    view.num_voxels = embeddings.numel() / kEmbeddingChannels;
    SPS_CHECK(corners.numel() == kCellCorners * view.num_voxels,
              "spslam: corner_ids and embeddings must have the same rows");
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
    load_layout(layout, texels.numel() / kPlaneChannels);
  }

  SceneView view;

 private:
  void load_layout(const std::vector<std::int64_t>& layout, std::int64_t rows) {
    for (int plane = 0; plane < 3; ++plane) {
      const std::int64_t* p = layout.data() + 5 * plane;
      SPS_CHECK(p[0] >= 0 && p[3] >= 0 && p[4] >= 0 && p[0] + p[3] * p[4] <= rows,
                "spslam: plane_layout must lie within texels");
      view.planes.planes[plane] = {p[0], static_cast<std::int32_t>(p[1]), static_cast<std::int32_t>(p[2]),
                                   static_cast<std::int32_t>(p[3]), static_cast<std::int32_t>(p[4])};
    }
  }

  std::vector<Tensor> tensors_;
};

}  // namespace spslam::bindings
