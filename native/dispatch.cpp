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
// Asked of the processor itself: __builtin_cpu_supports does not know "f16c" in clang 14.
bool has_f16c() {
  unsigned int eax = 0, ebx = 0, ecx = 0, edx = 0;
  return __get_cpuid(1, &eax, &ebx, &ecx, &edx) != 0 && (ecx & bit_F16C) != 0;
}
#endif

const Kernels* find(const char* name) {
#if defined(SPLATSEG_HAS_X86)
  __builtin_cpu_init();
  if (!std::strcmp(name, "avx512"))
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                   __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl")
               ? &avx512::table()
               : nullptr;
  if (!std::strcmp(name, "avx2"))
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && has_f16c()
               ? &avx2::table()
               : nullptr;
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
