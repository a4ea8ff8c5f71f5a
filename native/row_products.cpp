// Products of rows with vectors; see row_products.h.
#include "row_products.h"

#include <cstdint>
#include <cstring>

#include "frame.h"
#include "simd.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kTogether = 4;  // vectors whose sums are held in registers

inline Vec widened(const float* p) { return load(p); }
inline Vec widened(const uint16_t* p) { return load_half(p); }
inline Vec widened(const int8_t* p) { return load_bytes(p); }

template <int count, class T>
inline void products(const T* row, int64_t channels, const float* vectors, float* out) {
  Vec sums[count];
  for (int j = 0; j < count; ++j) sums[j] = set(0.0f);
  const int64_t whole = channels / kLanes * kLanes;
  for (int64_t c = 0; c < whole; c += kLanes) {
    const Vec value = widened(row + c);
    for (int j = 0; j < count; ++j) sums[j] = fma(value, load(vectors + j * channels + c), sums[j]);
  }
  if (whole < channels) {
    const int left = static_cast<int>(channels - whole);
    T rest[kLanes] = {};
    std::memcpy(rest, row + whole, sizeof(T) * static_cast<size_t>(left));
    const Vec value = widened(rest);
    for (int j = 0; j < count; ++j)
      sums[j] = fma(value, load_some(vectors + j * channels + whole, left), sums[j]);
  }
  for (int j = 0; j < count; ++j) out[j] = sum(sums[j]);
}

template <class T>
void of_rows(const RowProducts& asked, int64_t begin, int64_t end) {
  const int64_t channels = asked.channels;
  for (int64_t i = begin; i < end; ++i) {
    const T* row = static_cast<const T*>(asked.rows) + i * channels;
    const float* vectors = asked.vectors;
    float* out = asked.out + i * asked.count;
    int64_t left = asked.count;
    for (; left >= kTogether; left -= kTogether, vectors += kTogether * channels, out += kTogether)
      products<kTogether>(row, channels, vectors, out);
    if (left == 3) products<3>(row, channels, vectors, out);
    if (left == 2) products<2>(row, channels, vectors, out);
    if (left == 1) products<1>(row, channels, vectors, out);
  }
}

}  // namespace

void row_products(const RowProducts& asked, int64_t begin, int64_t end) {
  switch (asked.stored) {
    case Stored::float32: return of_rows<float>(asked, begin, end);
    case Stored::float16: return of_rows<uint16_t>(asked, begin, end);
    case Stored::int8: return of_rows<int8_t>(asked, begin, end);
  }
}

}  // namespace splatseg::SPLATSEG_ISA
