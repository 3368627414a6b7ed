#include "spslam/descriptors.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

// Where it is read in words: a copy of bytes that begin anywhere else than a word.
Tensor in_words(const Tensor& bytes) {
  const Tensor whole = as_contiguous(bytes);
  const bool is_aligned = reinterpret_cast<std::uintptr_t>(data<std::uint8_t>(whole)) % sizeof(std::uint64_t) == 0;
  return is_aligned ? whole : torch::stable::clone(whole);
}

std::tuple<Tensor, Tensor> nearest_descriptors(Tensor descriptors, Tensor others) {
  constexpr char kName[] = "nearest_descriptors";
  constexpr std::int64_t kWordBytes = sizeof(std::uint64_t);
  SPS_CHECK(has_shape(descriptors, {-1, -1}) && has_shape(others, {-1, descriptors.size(1)}), kName,
            ": descriptors and others must have shapes [N, B] and [M, B]");
  const std::int64_t bytes = descriptors.size(1);
  SPS_CHECK(bytes > 0 && bytes % kWordBytes == 0 && bytes <= kWordBytes * kMaxDescriptorWords, kName,
            ": descriptors must have a multiple of ", kWordBytes, " bytes each, at most ",
            kWordBytes * kMaxDescriptorWords);
  DeviceScope scope(descriptors);
  descriptors = in_words(descriptors);
  others = in_words(others);
  const auto words_of = [](const Tensor& tensor) {
    return Descriptors{reinterpret_cast<const std::uint64_t*>(data<std::uint8_t>(tensor)), tensor.size(0)};
  };
  const Tensor nearest = empty(descriptors, {descriptors.size(0)}, ScalarType::Long),
               distances = empty(descriptors, {descriptors.size(0), 2}, ScalarType::Int);
  spslam::nearest_descriptors(scope.context, words_of(descriptors), words_of(others),
                              static_cast<std::int32_t>(bytes / kWordBytes), mutable_data<std::int64_t>(nearest),
                              mutable_data<std::int32_t>(distances));
  return {nearest, distances};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("nearest_descriptors(Tensor descriptors, Tensor others) -> (Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("nearest_descriptors", TORCH_BOX(&nearest_descriptors));
}

}  // namespace spslam::bindings
