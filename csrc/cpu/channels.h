// Loops over channels whose number is known when compiled where it is a common one.
#pragma once

#include <cstdint>
#include <type_traits>

namespace spslam {

// Calls f with the number of channels as a constant where it is one of kCommon, else with 0.
template <int... kCommon, class F>
inline void with_channels(std::int64_t channels, const F& f) {
  const bool is_common = ((channels == kCommon && (f(std::integral_constant<int, kCommon>{}), true)) || ...);
  if (!is_common) f(std::integral_constant<int, 0>{});
}

}  // namespace spslam
