#include "spslam/prior_fusion.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

void fuse_prior_(Tensor embeddings, Tensor weights, Tensor voxel_ids, Tensor features, Tensor feature_weights,
                 double max_weight) {
  voxel_ids = contiguous(voxel_ids);
  features = contiguous(features);
  feature_weights = contiguous(feature_weights);
  const std::int64_t count = voxel_ids.numel();
  STD_TORCH_CHECK(features.numel() == 8 * count && feature_weights.numel() == count && embeddings.dim() == 2 &&
                      embeddings.size(1) == 8 && weights.numel() == embeddings.size(0),
                  "fuse_prior_: embeddings and features must have 8 channels and a row a weight");
  DeviceScope scope(embeddings);
  fuse_prior(scope.context, data<std::int32_t>(voxel_ids), data<float>(features), data<float>(feature_weights), count,
             embeddings.size(0), static_cast<float>(max_weight), mutable_data<float>(embeddings),
             mutable_data<float>(weights));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "fuse_prior_(Tensor(a!) embeddings, Tensor(b!) weights, Tensor voxel_ids, Tensor features, Tensor "
      "feature_weights, float max_weight) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("fuse_prior_", TORCH_BOX(&fuse_prior_));
}

}  // namespace spslam::bindings
