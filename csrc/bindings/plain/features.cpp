// Image features, for Python by ctypes.
#include <new>

#include "spslam/orb_features.h"

// size: rows and columns. options: those of `OrbOptions` in its order. Returns how many features there are, or -1 where
// there is not enough memory.
extern "C" __attribute__((visibility("default"))) std::int64_t spslam_orb_features(const std::uint8_t* intensity,
                                                                                   const std::int32_t* size,
                                                                                   const std::int32_t* options,
                                                                                   float* positions,
                                                                                   std::uint8_t* descriptors) {
  try {
    return spslam::orb_features(spslam::Cpu{}, intensity, size[0], size[1],
                                {options[0], options[1], options[2], options[3], options[4]}, positions, descriptors);
  } catch (const std::bad_alloc&) {
    return -1;
  }
}
