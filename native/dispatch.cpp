// Which instruction set the kernels use: the best this machine has, or SPLATSEG_ISA.
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <initializer_list>

#include "frame.h"

namespace splatseg {
namespace {

const Kernels* find(const char* name) {
#if defined(SPLATSEG_HAS_X86)
  __builtin_cpu_init();
  if (!std::strcmp(name, "avx512"))
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                   __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl")
               ? &avx512::table()
               : nullptr;
  if (!std::strcmp(name, "avx2"))
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                   __builtin_cpu_supports("f16c")
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
