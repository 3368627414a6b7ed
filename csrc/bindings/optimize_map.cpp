#include "spslam/optimize_map.h"

#include "bindings/launch_graph.h"
#include "bindings/render_options.h"
#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "optimize_map_";

#ifdef SPS_CUDA
using GradientSum = std::int64_t;
#else
using GradientSum = float;
#endif

void check_size(const Tensor& tensor, std::int64_t size, const char* name) {
  SPS_CHECK(tensor.numel() >= size, kName, ": ", name, " must have at least ", size, " elements, got ", tensor.numel());
}

// Places in the op's lists of numbers; spslam/ops/optimize_map.py fills them. A rate below 0 freezes its parameters.
enum class Rate { kEmbeddings, kTexels, kGeometryParams, kColorParams, kPoses, kCount };
enum class Integer {
  kPixelStream,
  kNumPixels,
  kIterations,
  kFixedFrame,
  kFirstStep,
  kFirstColorStep,
  kFirstStamp,
  kGraph,
  kCount
};

// Hands out the moments of the parameters that are not frozen, which come in the order of Rate: exp_avg and exp_avg_sq,
// and gradients and stamps of a table.
class Moments {
 public:
  Moments(const std::vector<Tensor>& tensors, const Scalars<Rate>& rates, std::int64_t first_step,
          std::int64_t first_color_step)
      : tensors_(tensors), rates_(rates), first_step_(first_step), first_color_step_(first_color_step) {}

  AdamState state(Rate rate, const Tensor& param, std::int64_t size, const char* name) {
    if (!(rates_[rate] >= 0.0)) return {};
    float* const values = checked<float>(param, size, name);
    float* const exp_avg = checked<float>(next(name), size, name);
    const bool is_color = rate == Rate::kTexels || rate == Rate::kColorParams;
    return {values, exp_avg, checked<float>(next(name), size, name), rates_[rate],
            is_color ? first_color_step_ : first_step_};
  }

  AdamTable table(Rate rate, const Tensor& param, std::int64_t rows, std::int64_t channels, const char* name) {
    const AdamState of_values = state(rate, param, rows * channels, name);
    if (!of_values.exp_avg) return {};
    GradientSum* const gradients = checked<GradientSum>(next(name), rows * channels, name);
    return {of_values, gradients, checked<std::int32_t>(next(name), rows, name)};
  }

  void check_end() const { SPS_CHECK(next_ == tensors_.size(), kName, ": moments must have a rate of at least 0"); }

 private:
  template <class T>
  static T* checked(const Tensor& tensor, std::int64_t size, const char* name) {
    check_size(tensor, size, name);
    return mutable_data<T>(tensor);
  }

  const Tensor& next(const char* name) {
    SPS_CHECK(next_ < tensors_.size(), kName, ": moments must hold those of ", name);
    return tensors_[next_++];
  }

  const std::vector<Tensor>& tensors_;
  const Scalars<Rate>& rates_;
  const std::int64_t first_step_, first_color_step_;
  std::size_t next_ = 0;
};

// The frames on the kernel's device. The driver stages so small a copy of pageable memory at once, so nothing waits,
// and the list may change afterwards.
Tensor frames_on_device(const Tensor& frames, const Tensor& like, std::int64_t rows, const Context& context) {
  Tensor list = as_contiguous(frames);
#ifdef SPS_CUDA
  if (list.is_cuda()) return list;
#endif
  const std::int64_t* at = data<std::int64_t>(list);
  for (std::int64_t i = 0; i < list.numel(); ++i) {
    SPS_CHECK(at[i] >= 0 && at[i] < rows, kName, ": frames must be in [0, ", rows, "), got ", at[i]);
  }
#ifdef SPS_CUDA
  const std::vector<std::int64_t> pageable(at, at + list.numel());
  Tensor copy = empty(like, {list.numel()}, ScalarType::Long);
  STD_CUDA_CHECK(cudaMemcpyAsync(copy.mutable_data_ptr(), pageable.data(), pageable.size() * sizeof(std::int64_t),
                                 cudaMemcpyHostToDevice, static_cast<cudaStream_t>(context.stream)));
  return copy;
#else
  (void)like, (void)context;
  return list;
#endif
}

void optimize_map_(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                   std::vector<std::int64_t> plane_layout, Tensor records, Tensor poses, Tensor frames,
                   std::vector<double> render_scalars, std::vector<std::int64_t> render_integers,
                   std::vector<Tensor> moment_list, std::vector<double> rate_list,
                   std::vector<std::int64_t> integer_list, Tensor losses) {
  const Scalars<Rate> rates(kName, "rates", rate_list);
  const Integers<Integer> integers(kName, "integers", integer_list);
  SPS_CHECK(records.dim() == 3 && records.size(1) >= 1 && records.size(2) == 3, kName,
            ": records must have shape [F, P, 3] with P >= 1");
  SPS_CHECK(poses.dim() == 2 && poses.size(0) == records.size(0) && poses.size(1) == kPoseSize, kName,
            ": poses must have shape [F, 7]");
  SPS_CHECK(frames.dim() == 1 && frames.numel() >= 1, kName, ": frames must have shape [n] with n >= 1");
  check_count(kName, "num_pixels", integers[Integer::kNumPixels]);
  check_count(kName, "iterations", integers[Integer::kIterations]);
  check_count(kName, "first_step", integers[Integer::kFirstStep]);
  check_count(kName, "first_color_step", integers[Integer::kFirstColorStep]);
  to_int32(kName, "first_stamp", integers[Integer::kFirstStamp]);
  to_int32(kName, "last stamp", integers[Integer::kFirstStamp] + integers[Integer::kIterations] - 1);
  check_size(losses, kLossTerms * integers[Integer::kIterations], "losses");
  DeviceScope scope(poses);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  const RenderArgument render(kName, render_scalars, render_integers);
  const std::int64_t num_texels = scene_tensors[5].numel() / kPlaneChannels;
  records = as_contiguous(records);
  frames = frames_on_device(frames, poses, poses.size(0), scope.context);
  MapOptimization call{};
  call.scene = scene.view;
  call.rays.records = data<std::int32_t>(records);
  call.rays.records_per_row = records.size(1);
  call.rays.draw = render.pixel_key(integers[Integer::kPixelStream]);
  call.rays.slot_rows = data<std::int64_t>(frames);
  call.rays.num_rays = integers[Integer::kNumPixels];
  call.rays.num_slots = frames.numel();
  call.rays.poses = mutable_data<float>(poses);
  call.intrinsics = render.intrinsics;
  call.options = render.options;
  Moments moments(moment_list, rates, integers[Integer::kFirstStep], integers[Integer::kFirstColorStep]);
  call.embeddings =
      moments.table(Rate::kEmbeddings, scene_tensors[3], scene.view.num_voxels, kEmbeddingChannels, "embeddings");
  call.texels = moments.table(Rate::kTexels, scene_tensors[5], num_texels, kPlaneChannels, "texels");
  call.geometry_params =
      moments.state(Rate::kGeometryParams, scene_tensors[4], kGeometryDecoder.num_params(), "geometry_params");
  call.color_params = moments.state(Rate::kColorParams, scene_tensors[6], kColorDecoder.num_params(), "color_params");
  call.poses = moments.state(Rate::kPoses, poses, poses.numel(), "poses");
  moments.check_end();
  call.fixed_row = integers[Integer::kFixedFrame];
  call.iterations = integers[Integer::kIterations];
  call.first_stamp = integers.as<std::int32_t>(Integer::kFirstStamp);
  call.losses = mutable_data<float>(losses);
  Tensor workspace = empty(losses, {optimize_map_workspace_size(scope.context, call)}, ScalarType::Byte);
  optimize_map(scope.context, call, workspace.mutable_data_ptr(), find_launch_graph(integers[Integer::kGraph]));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "optimize_map_(Tensor(a!)[] scene, float[] scene_scalars, int[] plane_layout, Tensor records, Tensor(b!) poses, "
      "Tensor frames, " SPS_RENDER_SCHEMA
      ", Tensor(c!)[] moments, float[] rates, int[] integers, Tensor(d!) losses) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("optimize_map_", TORCH_BOX(&optimize_map_));
}

}  // namespace spslam::bindings
