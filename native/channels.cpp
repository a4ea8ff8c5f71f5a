#include "channels.h"

#include <algorithm>

#include "pool.h"

namespace splatseg {
namespace {

// Memory of one thread. Of the sums only what a tile uses is ever touched.
struct Room {
  std::vector<int32_t> slot;
  Buffer<int32_t> channels, entries;
  Buffer<float> sums, scratch;
};

}  // namespace

void argmax(View& view, const SparseSignal& signal, int64_t channels, int32_t* winner,
            float* score) {
  const Frame& frame = view.frame();
  std::vector<Room> rooms(static_cast<size_t>(threads()));
  parallel_for_thread(view.tiles(), 4, [&](int thread, int64_t begin, int64_t end) {
    Room& room = rooms[static_cast<size_t>(thread)];
    room.slot.resize(static_cast<size_t>(channels), -1);
    void* scratch = room.scratch.resize(kTileScratchBytes / 4);
    for (int64_t tile = begin; tile < end; ++tile) {
      const int64_t listed = frame.tile_begin[tile + 1] - frame.tile_begin[tile];
      const int64_t most = std::min(channels, listed * signal.per_row + 1);
      ChannelSums sums{room.slot.data(), room.channels.resize(most), room.sums.resize(most * 256),
                       room.entries.resize(int64_t{kChunk} * signal.per_row), 0};
      kernels().argmax(frame, static_cast<int>(tile), scratch, signal, sums, winner, score);
    }
  });
}

}  // namespace splatseg
