#include "spslam/depth_image_alignment.h"

#include "bindings/depth_keyframes.h"

namespace spslam::bindings {
namespace {

// Places in the ops' lists of numbers; spslam/ops/depth_image_alignment.py fills them.
enum class ImageScalar { kFx, kFy, kCx, kCy, kUnit, kPixelFx, kPixelFy, kPixelCx, kPixelCy, kCount };
enum class AlignmentScalar { kKernelStart, kKernelEnd, kDamping, kCount };
enum class AlignmentInteger { kNumPixels, kIterations, kSeed, kStream, kFrame, kCount };
enum class ComparisonScalar { kTolerance, kToleranceDeviations, kClearTolerances, kCount };

// The tensors of a call, in order: depth [R, H, W], records [N, P, 3], pairs [B, 2], poses [B, 7], numbers [N] (to
// align) or normals [N, P, 3] (to compare), and if they are known noise [4] and, after it, intensities [R, H, W].
class Arguments {
 public:
  Arguments(const char* name, const std::vector<Tensor>& tensors, const std::vector<double>& numbers)
      : name_(name), tensors_(all_contiguous(tensors)), scalars_(name, "image_scalars", numbers) {
    SPS_CHECK(tensors_.size() >= kRequired && tensors_.size() <= kRequired + 2, name, ": wrong number of tensors");
    SPS_CHECK(depth().dim() == 3, name, ": depth must have shape [R, H, W]");
    SPS_CHECK(records().dim() == 3 && records().size(2) == 3, name, ": pixels must have shape [N, P, 3]");
    SPS_CHECK(has_shape(pairs(), {-1, 2}), name, ": pairs must have shape [B, 2]");
    SPS_CHECK(has_shape(poses(), {pairs().size(0), kPoseSize}), name, ": poses must have shape [B, 7]");
    SPS_CHECK(scalars_[ImageScalar::kUnit] > 0.0, name, ": unit must be positive");
    SPS_CHECK(!has_noise() || tensors_[kRequired].numel() == kSensorNoiseSize, name, ": noise must have 4 elements");
    SPS_CHECK(tensors_.size() < kRequired + 2 || same_shape(tensors_[kRequired + 1], depth()), name,
              ": intensities must have the shape of depth");
    check_count(name, "pairs", pairs().size(0), 0);
  }

  const Tensor& depth() const { return tensors_[0]; }
  const Tensor& records() const { return tensors_[1]; }
  const Tensor& pairs() const { return tensors_[2]; }
  const Tensor& poses() const { return tensors_[3]; }
  const Tensor& per_pixel_set() const { return tensors_[4]; }
  bool has_noise() const { return tensors_.size() > kRequired; }

  PixelSets pixels() const { return {data<std::int32_t>(records()), records().size(0), records().size(1)}; }
  ImagePairs image_pairs() const { return {data<std::int64_t>(pairs()), pairs().size(0)}; }

  // Of one keyframe in use; the kernel's widths are the caller's.
  GaussNewtonOptions options() const {
    GaussNewtonOptions options{};
    options.intrinsics = {scalars_.as<float>(ImageScalar::kPixelFx), scalars_.as<float>(ImageScalar::kPixelFy),
                          scalars_.as<float>(ImageScalar::kPixelCx), scalars_.as<float>(ImageScalar::kPixelCy)};
    options.noise = has_noise() ? data<float>(tensors_[kRequired]) : nullptr;
    DepthKeyframes& images = options.depth_keyframes;
    images.images = data<std::uint16_t>(depth());
    images.intensities = tensors_.size() == kRequired + 2 ? data<std::uint8_t>(tensors_[kRequired + 1]) : nullptr;
    images.height = depth().size(1);
    images.width = depth().size(2);
    images.intrinsics = load_intrinsics(scalars_);
    images.unit = scalars_.as<float>(ImageScalar::kUnit);
    images.count = 1;
    return options;
  }

 private:
  static constexpr std::size_t kRequired = 5;
  const char* name_;
  std::vector<Tensor> tensors_;
  Scalars<ImageScalar> scalars_;
};

Tensor align_depth_images(std::vector<Tensor> tensors, std::vector<double> image_scalars, std::vector<double> scalars,
                          std::vector<std::int64_t> integers) {
  constexpr char kName[] = "align_depth_images";
  const Arguments arguments(kName, tensors, image_scalars);
  const Scalars<AlignmentScalar> widths(kName, "scalars", scalars);
  const Integers<AlignmentInteger> counts(kName, "integers", integers);
  SPS_CHECK(arguments.per_pixel_set().numel() == arguments.records().size(0), kName, ": numbers must have N elements");
  SPS_CHECK(arguments.records().size(1) > 0, kName, ": pixels must have at least one per image");
  DeviceScope scope(arguments.poses());
  GaussNewtonOptions options = arguments.options();
  options.num_pixels = counts[AlignmentInteger::kNumPixels];
  options.iterations = counts[AlignmentInteger::kIterations];
  check_count(kName, "num_pixels", options.num_pixels);
  check_count(kName, "iterations", options.iterations);
  options.kernel_start = widths.as<float>(AlignmentScalar::kKernelStart);
  options.kernel_end = options.depth_keyframes.kernel_end = widths.as<float>(AlignmentScalar::kKernelEnd);
  options.damping = widths[AlignmentScalar::kDamping];
  options.key = load_key(counts, 0);
  Tensor poses = torch::stable::clone(arguments.poses());
  spslam::align_depth_images(scope.context, arguments.pixels(), data<std::int64_t>(arguments.per_pixel_set()),
                             arguments.image_pairs(), arguments.depth().size(0), options, mutable_data<float>(poses));
  return poses;
}

Tensor compare_depth_images(std::vector<Tensor> tensors, std::vector<double> image_scalars,
                            std::vector<double> scalars) {
  constexpr char kName[] = "compare_depth_images";
  const Arguments arguments(kName, tensors, image_scalars);
  const Scalars<ComparisonScalar> numbers(kName, "scalars", scalars);
  SPS_CHECK(arguments.has_noise(), kName, ": noise must be given");
  SPS_CHECK(same_shape(arguments.per_pixel_set(), arguments.records()), kName, ": normals must have shape [N, P, 3]");
  DeviceScope scope(arguments.poses());
  const ComparisonOptions comparison{numbers.as<float>(ComparisonScalar::kTolerance),
                                     numbers.as<float>(ComparisonScalar::kToleranceDeviations),
                                     numbers.as<float>(ComparisonScalar::kClearTolerances)};
  Tensor sums = zeros(arguments.poses(), {arguments.pairs().size(0), kComparisonTerms}, ScalarType::Double);
  spslam::compare_depth_images(scope.context, arguments.pixels(), data<float>(arguments.per_pixel_set()),
                               arguments.image_pairs(), arguments.depth().size(0), arguments.options(), comparison,
                               data<float>(arguments.poses()), mutable_data<double>(sums));
  return sums;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("align_depth_images(Tensor[] tensors, float[] image_scalars, float[] scalars, int[] integers) -> Tensor");
  m.def("compare_depth_images(Tensor[] tensors, float[] image_scalars, float[] scalars) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("align_depth_images", TORCH_BOX(&align_depth_images));
  m.impl("compare_depth_images", TORCH_BOX(&compare_depth_images));
}

}  // namespace spslam::bindings
