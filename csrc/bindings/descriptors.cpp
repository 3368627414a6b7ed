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

Descriptors words_of(const Tensor& tensor) {
  return {reinterpret_cast<const std::uint64_t*>(data<std::uint8_t>(tensor)), tensor.size(0)};
}

std::int32_t checked_words(const char* name, const Tensor& descriptors, const Tensor& others) {
  constexpr std::int64_t kWordBytes = sizeof(std::uint64_t);
  SPS_CHECK(has_shape(descriptors, {-1, -1}) && has_shape(others, {-1, descriptors.size(1)}), name,
            ": descriptors and others must have shapes [N, B] and [M, B]");
  const std::int64_t bytes = descriptors.size(1);
  SPS_CHECK(bytes > 0 && bytes % kWordBytes == 0 && bytes <= kWordBytes * kMaxDescriptorWords, name,
            ": descriptors must have a multiple of ", kWordBytes, " bytes each, at most ",
            kWordBytes * kMaxDescriptorWords);
  return static_cast<std::int32_t>(bytes / kWordBytes);
}

std::tuple<Tensor, Tensor> nearest_descriptors(Tensor descriptors, Tensor others) {
  const std::int32_t words = checked_words("nearest_descriptors", descriptors, others);
  DeviceScope scope(descriptors);
  descriptors = in_words(descriptors);
  others = in_words(others);
  const Tensor nearest = empty(descriptors, {descriptors.size(0)}, ScalarType::Long),
               distances = empty(descriptors, {descriptors.size(0), 2}, ScalarType::Int);
  spslam::nearest_descriptors(scope.context, words_of(descriptors), {{words_of(others)}, 1}, words,
                              mutable_data<std::int64_t>(nearest), mutable_data<std::int32_t>(distances));
  return {nearest, distances};
}

// Of groups of `others`, one after the other, with so many each. Returns [2, G, N]: the places, and the two distances
// in the halves of a word.
Tensor nearest_in_groups(Tensor descriptors, Tensor others, std::vector<std::int64_t> sizes) {
  constexpr char kName[] = "nearest_in_groups";
  const std::int32_t words = checked_words(kName, descriptors, others);
  const auto count = static_cast<std::int64_t>(sizes.size());
  SPS_CHECK(count <= kMaxDescriptorGroups, kName, ": sizes must be ", kMaxDescriptorGroups, " at most");
  DeviceScope scope(descriptors);
  descriptors = in_words(descriptors);
  others = in_words(others);
  DescriptorGroups groups{{}, static_cast<std::int32_t>(count)};
  std::int64_t begin = 0;
  for (std::int64_t i = 0; i < count; ++i) {
    SPS_CHECK(sizes[i] >= 0 && sizes[i] <= others.size(0) - begin, kName, ": others must have as many rows as sizes");
    groups.of[i] = {words_of(others).words + begin * words, sizes[i]};
    begin += sizes[i];
  }
  const Tensor found = empty(descriptors, {2, count, descriptors.size(0)}, ScalarType::Long);
  std::int64_t* nearest = mutable_data<std::int64_t>(found);
  spslam::nearest_descriptors(scope.context, words_of(descriptors), groups, words, nearest,
                              reinterpret_cast<std::int32_t*>(nearest + count * descriptors.size(0)));
  return found;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("nearest_descriptors(Tensor descriptors, Tensor others) -> (Tensor, Tensor)");
  m.def("nearest_in_groups(Tensor descriptors, Tensor others, int[] sizes) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("nearest_descriptors", TORCH_BOX(&nearest_descriptors));
  m.impl("nearest_in_groups", TORCH_BOX(&nearest_in_groups));
}

}  // namespace spslam::bindings
