#include "spslam/rolling_shutter.h"

#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

// Places in the ops' lists of numbers; spslam/ops/rolling_shutter.py and trusted.py fill them.
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

void check_records(const char* name, const Tensor& records, std::int64_t height, std::int64_t width) {
  SPS_CHECK(has_shape(records, {-1, 3}), name, ": records must have shape [P, 3]");
  SPS_CHECK(height > 1 && width > 1, name, ": height and width must be above 1");
}

void check_images(const char* name, const Tensor& depth, const Tensor& intensity, double unit) {
  SPS_CHECK(depth.dim() == 2 && depth.size(0) > 1 && depth.size(1) > 1, name,
            ": depth must have shape [H, W], at least two rows and columns");
  SPS_CHECK(same_shape(intensity, depth), name, ": all images must have one shape");
  SPS_CHECK(unit > 0.0, name, ": unit must be positive");
}

void rectify_shutter_records(Tensor out, Tensor records, Tensor before, Tensor pose, Tensor readout,
                             std::vector<double> numbers, std::int64_t height, std::int64_t width) {
  constexpr char kName[] = "rectify_shutter_records_";
  const Scalars<RecordScalar> scalars(kName, "scalars", numbers);
  check_records(kName, records, height, width);
  SPS_CHECK(same_shape(out, records) && out.is_contiguous(), kName, ": out must be as records, contiguous");
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
  check_images(kName, depth, intensity, scalars[ImageScalar::kUnit]);
  SPS_CHECK(same_shape(out_depth, depth) && same_shape(out_intensity, depth) && out_depth.is_contiguous() &&
                out_intensity.is_contiguous(),
            kName, ": results must have the images' shape, and be contiguous");
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
  constexpr char kName[] = "rectify_shutter_frame";
  const Scalars<FrameScalar> scalars(kName, "scalars", numbers);
  check_records(kName, records, height, width);
  check_images(kName, depth, intensity, scalars[FrameScalar::kUnit]);
  DeviceScope scope(records);
  records = as_contiguous(records), depth = as_contiguous(depth), intensity = as_contiguous(intensity);
  before = as_contiguous(before), pose = as_contiguous(pose), readout = as_contiguous(readout);
  const std::int64_t rows = depth.size(0), columns = depth.size(1);
  Tensor out = empty(records, {records.size(0), 3}, ScalarType::Int);
  Tensor out_depth = empty(depth, {rows, columns}, ScalarType::UInt16);
  Tensor out_intensity = empty(depth, {rows, columns}, ScalarType::Byte);
  const ShutterMotion motion = load_shutter_motion(kName, before, pose, readout, scalars[FrameScalar::kSeconds]);
  const Intrinsics image_camera{scalars.as<float>(FrameScalar::kImageFx), scalars.as<float>(FrameScalar::kImageFy),
                                scalars.as<float>(FrameScalar::kImageCx), scalars.as<float>(FrameScalar::kImageCy)};
  spslam::rectify_shutter_frame(
      scope.context, data<std::int32_t>(records), records.size(0),
      {data<std::uint16_t>(depth), data<std::uint8_t>(intensity), scalars.as<float>(FrameScalar::kUnit)}, motion,
      {load_intrinsics(scalars), height, width}, {image_camera, rows, columns},
      {mutable_data<std::int32_t>(out), mutable_data<std::uint16_t>(out_depth),
       mutable_data<std::uint8_t>(out_intensity)});
  return {out, out_depth, out_intensity};
}

// The pose `steps` after rows `last` - 1 and `last` of a table of poses, the readout, and the records as that motion
// rectifies them: all of them new.
std::tuple<Tensor, Tensor, Tensor> predict_frame(Tensor poses, std::int64_t last, Tensor readout, Tensor records,
                                                 std::vector<double> numbers, std::int64_t height, std::int64_t width,
                                                 double steps) {
  constexpr char kName[] = "predict_frame";
  const Scalars<RecordScalar> scalars(kName, "scalars", numbers);
  check_records(kName, records, height, width);
  SPS_CHECK(has_shape(poses, {-1, kPoseSize}) && last >= 1 && last < poses.size(0), kName,
            ": poses must have shape [F, ", kPoseSize, "], and last be one of its rows after the first, got ", last);
  SPS_CHECK(readout.numel() == 1, kName, ": readout must have one element");
  SPS_CHECK(scalars[RecordScalar::kSeconds] > 0.0 && steps > 0.0, kName, ": seconds and steps must be positive");
  DeviceScope scope(records);
  records = as_contiguous(records), poses = as_contiguous(poses), readout = as_contiguous(readout);
  Tensor pose = empty(poses, {kPoseSize}, ScalarType::Float);
  Tensor out_readout = empty(poses, {1}, ScalarType::Float);
  Tensor out = empty(records, {records.size(0), 3}, ScalarType::Int);
  const float* const at = data<float>(poses) + kPoseSize * last;
  spslam::predict_frame(scope.context, {at - kPoseSize, at, static_cast<float>(steps)}, data<float>(readout),
                        scalars.as<float>(RecordScalar::kSeconds), data<std::int32_t>(records), records.size(0),
                        {load_intrinsics(scalars), height, width},
                        {mutable_data<float>(pose), mutable_data<float>(out_readout), mutable_data<std::int32_t>(out)});
  return {pose, out_readout, out};
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
  m.def(
      "predict_frame(Tensor poses, int last, Tensor readout, Tensor records, float[] scalars, int height, int width, "
      "float steps) -> (Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("rectify_shutter_records_", TORCH_BOX(&rectify_shutter_records));
  m.impl("rectify_shutter_images_", TORCH_BOX(&rectify_shutter_images));
  m.impl("rectify_shutter_frame", TORCH_BOX(&rectify_shutter_frame));
  m.impl("predict_frame", TORCH_BOX(&predict_frame));
}

}  // namespace spslam::bindings
