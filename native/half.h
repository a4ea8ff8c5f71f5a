// Half precision as weights are kept in.
#pragma once

#include <cstdint>
#include <cstring>

namespace splatseg {

inline float float_from_half(uint16_t h) {
  const uint32_t sign = static_cast<uint32_t>(h & 0x8000u) << 16, e = (h >> 10) & 31u, m = h & 1023u;
  float f;
  if (!e) {
    f = static_cast<float>(m) * 5.9604644775390625e-8f;
    return sign ? -f : f;
  }
  const uint32_t bits = sign | ((e + 112u) << 23) | (m << 13);
  std::memcpy(&f, &bits, 4);
  return f;
}

}  // namespace splatseg
