// Numbers that an op takes as one list: another one is another entry of an enum, not another parameter.
#pragma once

#include <type_traits>

#include "bindings/common.h"

namespace spslam::bindings {

// A list of numbers whose places the enum `Place` names, the last of it kCount. Python fills it in the same order.
template <class Place, class T>
class NumberList {
 public:
  NumberList(const char* function, const char* argument, const std::vector<T>& values)
      : function_(function), argument_(argument), values_(values) {
    SPS_CHECK(values.size() == static_cast<std::size_t>(Place::kCount), function, ": ", argument, " must have ",
              static_cast<int>(Place::kCount), " numbers, got ", values.size());
  }

  T operator[](Place place) const { return values_[static_cast<std::size_t>(place)]; }

  // A whole number must fit 32 bits where that is the type it is asked in.
  template <class U>
  U as(Place place) const {
    if constexpr (std::is_same_v<T, std::int64_t> && std::is_same_v<U, std::int32_t>) {
      return to_int32(function_, argument_, (*this)[place]);
    } else {
      return static_cast<U>((*this)[place]);
    }
  }

 private:
  const char *function_, *argument_;
  const std::vector<T>& values_;
};

template <class Place>
using Scalars = NumberList<Place, double>;
template <class Place>
using Integers = NumberList<Place, std::int64_t>;

// The camera at the places kFx to kCy.
template <class Place>
Intrinsics load_intrinsics(const Scalars<Place>& scalars) {
  return {scalars.template as<float>(Place::kFx), scalars.template as<float>(Place::kFy),
          scalars.template as<float>(Place::kCx), scalars.template as<float>(Place::kCy)};
}

// The key of the places kSeed, kStream and kFrame, and an iteration.
template <class Place>
PhiloxKey load_key(const Integers<Place>& integers, std::int64_t iteration) {
  return philox_key(integers[Place::kSeed], integers[Place::kStream], integers[Place::kFrame], iteration);
}

}  // namespace spslam::bindings
