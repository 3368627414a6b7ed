#include "spslam/rolling_shutter.h"

#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

// Places in the ops' lists of numbers; spslam/ops/rolling_shutter.py fills them.
enum class RecordScalar { kFx, kFy, kCx, kCy, kSeconds, kCount };
enum class ImageScalar { kFx, kFy, kCx, kCy, kSeconds, kUnit, kCount };
// Those of the records, the images' camera, seconds and the unit.
enum class FrameScalar { kFx, kFy, kCx, kCy, kImageFx, kImageFy, kImageCx, kImageCy, kSeconds, kUnit, kCount };

// The tensors must outlive the launch.
ShutterMotion load_shutter_motion(const char* name, const Tensor& before, const Tensor& pose, const Tensor& readout,
                                  double seconds) {
  SPS_CHECK(before.numel() == kPoseSize && pose.numel() == kPoseSize && readout.numel() == 1, name,
            ": poses must have ", kPoseSize, " elements, readout one");
  SPS_CHECK(seconds > 0.0, name, ": seconds must be positive");
  return {data<float>(before), data<float>(pose), data<float>(readout), static_cast<float>(seconds)};
}

void rectify_shutter_records(Tensor out, Tensor records, Tensor before, Tensor pose, Tensor readout,
                             std::vector<double> numbers, std::int64_t height, std::int64_t width) {
  constexpr char kName[] = "rectify_shutter_records_";
  const Scalars<RecordScalar> scalars(kName, "scalars", numbers);
  SPS_CHECK(has_shape(records, {-1, 3}) && same_shape(out, records) && out.is_contiguous(), kName,
            ": records must have shape [P, 3], and out too, contiguous");
  SPS_CHECK(height > 1 && width > 1, kName, ": height and width must be above 1");
  DeviceScope scope(records);
  records = as_contiguous(records);
  before = as_contiguous(before), pose = as_contiguous(pose), readout = as_contiguous(readout);
  const ShutterMotion motion = load_shutter_motion(kName, before, pose, readout, scalars[RecordScalar::kSeconds]);
  spslam::rectify_shutter_records(scope.context, data<std::int32_t>(records), records.size(0), motion,
                                  {load_intrinsics(scalars), height, width}, mutable_data<std::int32_t>(out));
}

void rectify_shutter_images(Tensor out_depth, Tensor out_intensity, Tensor depth, Tensor intensity, Tensor before,
                            Tensor pose, Tensor readout, std::vector<double> numbers) {
  constexpr char kName[] = "rectify_shutter_images_";
  const Scalars<ImageScalar> scalars(kName, "scalars", numbers);
  SPS_CHECK(depth.dim() == 2 && depth.size(0) > 1 && depth.size(1) > 1, kName,
            ": depth must have shape [H, W], at least two rows and columns");
  SPS_CHECK(same_shape(intensity, depth) && same_shape(out_depth, depth) && same_shape(out_intensity, depth) &&
                out_depth.is_contiguous() && out_intensity.is_contiguous(),
            kName, ": all images must have one shape, and results be contiguous");
  SPS_CHECK(scalars[ImageScalar::kUnit] > 0.0, kName, ": unit must be positive");
  DeviceScope scope(depth);
  depth = as_contiguous(depth), intensity = as_contiguous(intensity);
  before = as_contiguous(before), pose = as_contiguous(pose), readout = as_contiguous(readout);
  const ShutterMotion motion = load_shutter_motion(kName, before, pose, readout, scalars[ImageScalar::kSeconds]);
  spslam::rectify_shutter_images(
      scope.context, {data<std::uint16_t>(depth), data<std::uint8_t>(intensity), scalars.as<float>(ImageScalar::kUnit)},
      motion, {load_intrinsics(scalars), depth.size(0), depth.size(1)}, mutable_data<std::uint16_t>(out_depth),
      mutable_data<std::uint8_t>(out_intensity));
}

// Both in one call, to new tensors.
std::tuple<Tensor, Tensor, Tensor> rectify_shutter_frame(Tensor records, Tensor depth, Tensor intensity, Tensor before,
                                                         Tensor pose, Tensor readout, std::vector<double> numbers,
                                                         std::int64_t height, std::int64_t width) {
  const Scalars<FrameScalar> scalars("rectify_shutter_frame", "scalars", numbers);
  SPS_CHECK(has_shape(records, {-1, 3}) && depth.dim() == 2, "rectify_shutter_frame: records must have shape [P, 3], ",
            "depth [H, W]");
  const std::vector<std::int64_t> size{depth.size(0), depth.size(1)};
  Tensor out = empty(records, {records.size(0), 3}, ScalarType::Int);
  Tensor out_depth = empty(depth, size, ScalarType::UInt16);
  Tensor out_intensity = empty(depth, size, ScalarType::Byte);
  const double *camera = numbers.data(), *image_camera = camera + 4, seconds = scalars[FrameScalar::kSeconds];
  rectify_shutter_records(out, records, before, pose, readout, {camera[0], camera[1], camera[2], camera[3], seconds},
                          height, width);
  rectify_shutter_images(
      out_depth, out_intensity, depth, intensity, before, pose, readout,
      {image_camera[0], image_camera[1], image_camera[2], image_camera[3], seconds, scalars[FrameScalar::kUnit]});
  return {out, out_depth, out_intensity};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "rectify_shutter_records_(Tensor(a!) out, Tensor records, Tensor before, Tensor pose, Tensor readout, float[] "
      "scalars, int height, int width) -> ()");
  m.def(
      "rectify_shutter_images_(Tensor(a!) out_depth, Tensor(b!) out_intensity, Tensor depth, Tensor intensity, Tensor "
      "before, Tensor pose, Tensor readout, float[] scalars) -> ()");
  m.def(
      "rectify_shutter_frame(Tensor records, Tensor depth, Tensor intensity, Tensor before, Tensor pose, Tensor "
      "readout, float[] scalars, int height, int width) -> (Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("rectify_shutter_records_", TORCH_BOX(&rectify_shutter_records));
  m.impl("rectify_shutter_images_", TORCH_BOX(&rectify_shutter_images));
  m.impl("rectify_shutter_frame", TORCH_BOX(&rectify_shutter_frame));
}

}  // namespace spslam::bindings
