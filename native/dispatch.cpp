// Which instruction set the kernels use: the best this machine has, or SPLATSEG_ISA.
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <initializer_list>

#include "frame.h"

#if defined(SPLATSEG_HAS_X86)
#include <cpuid.h>
#endif

namespace splatseg {
namespace {

#if defined(SPLATSEG_HAS_X86)
// Asked of the processor itself: __builtin_cpu_supports does not know "f16c" in clang 14, and in
// the runtime of zig, which builds our wheels, it knows nothing.
struct Features {
  bool avx2 = false, avx512 = false;
};

Features features() {
  unsigned int eax = 0, ebx = 0, ecx = 0, edx = 0, state = 0, high = 0;
  constexpr unsigned int kNeeded = bit_OSXSAVE | bit_FMA | bit_F16C;
  if (!__get_cpuid(1, &eax, &ebx, &ecx, &edx) || (ecx & kNeeded) != kNeeded) return {};
  __asm__("xgetbv" : "=a"(state), "=d"(high) : "c"(0));  // registers that the system keeps
  if (!__get_cpuid_count(7, 0, &eax, &ebx, &ecx, &edx)) return {};
  constexpr unsigned int kWide = bit_AVX512F | bit_AVX512DQ | bit_AVX512BW | bit_AVX512VL;
  const bool avx2 = (state & 0x06) == 0x06 && (ebx & bit_AVX2) != 0;
  return {avx2, avx2 && (state & 0xe6) == 0xe6 && (ebx & kWide) == kWide};
}
#endif

const Kernels* find(const char* name) {
#if defined(SPLATSEG_HAS_X86)
  static const Features here = features();
  if (!std::strcmp(name, "avx512")) return here.avx512 ? &avx512::table() : nullptr;
  if (!std::strcmp(name, "avx2")) return here.avx2 ? &avx2::table() : nullptr;
#endif
  return std::strcmp(name, "portable") ? nullptr : &portable::table();
}

const Kernels* best() {
  if (const char* wanted = std::getenv("SPLATSEG_ISA"))
    if (const Kernels* found = find(wanted)) return found;
  for (const char* name : {"avx512", "avx2"})
    if (const Kernels* found = find(name)) return found;
  return &portable::table();
}

std::atomic<const Kernels*> chosen{nullptr};

}  // namespace

const Kernels& kernels() {
  const Kernels* table = chosen.load();
  if (!table) chosen = table = best();
  return *table;
}

bool set_isa(const char* name) {
  const Kernels* found = find(name);
  if (found) chosen = found;
  return found != nullptr;
}

}  // namespace splatseg
