#include "segments.h"

#include <algorithm>
#include <cstring>

#include "pool.h"

namespace splatseg {
namespace {

// What one tile shows of a sparse image, and memory for it that is used again.
struct TileColumns {
  std::vector<int32_t> all;  // ascending
  std::vector<int32_t> of_block[16];  // positions in `all`
  Buffer<float> values[16];
  TileImage image{};
  Buffer<float> scratch, chunk_rows;
  int widest = 0;

  void read(const Frame& frame, int tile, const SparseImage& from) {
    const int64_t left = tile % frame.tiles_x * kTile, top = tile / frame.tiles_x * kTile;
    auto pixel_of = [&](int block, int lane) -> int64_t {
      const int64_t x = left + (block & 3) * 4 + (lane & 3);
      const int64_t y = top + (block >> 2) * 4 + (lane >> 2);
      return x < frame.width && y < frame.height ? y * frame.width + x : -1;
    };
    all.clear();
    for (int b = 0; b < 16; ++b)
      for (int l = 0; l < 16; ++l) {
        const int64_t pixel = pixel_of(b, l);
        if (pixel < 0) continue;
        for (int64_t e = from.indptr[pixel]; e < from.indptr[pixel + 1]; ++e)
          if (all.empty() || all.back() != from.columns[e]) all.push_back(from.columns[e]);
      }
    std::sort(all.begin(), all.end());
    all.erase(std::unique(all.begin(), all.end()), all.end());
    widest = 0;
    for (int b = 0; b < 16; ++b) {
      std::vector<int32_t>& mine = of_block[b];
      mine.clear();
      for (int l = 0; l < 16; ++l) {
        const int64_t pixel = pixel_of(b, l);
        if (pixel < 0) continue;
        for (int64_t e = from.indptr[pixel]; e < from.indptr[pixel + 1]; ++e) {
          const int32_t at = position(from.columns[e]);
          if (std::find(mine.begin(), mine.end(), at) == mine.end()) mine.push_back(at);
        }
      }
      const int64_t channels = (static_cast<int64_t>(mine.size()) + 15) / 16 * 16;
      float* to = values[b].resize(16 * channels);
      std::fill_n(to, 16 * channels, 0.0F);  // where there are none, `to` is null
      for (int l = 0; l < 16; ++l) {
        const int64_t pixel = pixel_of(b, l);
        if (pixel < 0) continue;
        for (int64_t e = from.indptr[pixel]; e < from.indptr[pixel + 1]; ++e) {
          const auto found = std::find(mine.begin(), mine.end(), position(from.columns[e]));
          to[l * channels + (found - mine.begin())] = from.values[e];
        }
      }
      image.used[b] = static_cast<int32_t>(mine.size());
      image.columns[b] = mine.data();
      image.values[b] = to;
      widest = std::max(widest, static_cast<int>(channels));
    }
  }

  int32_t position(int32_t column) const {
    return static_cast<int32_t>(std::lower_bound(all.begin(), all.end(), column) - all.begin());
  }
};

struct Entry {
  int32_t gaussian, column;
  float sum;
};

// One entry a Gaussian and column; of several the sum in the order given, which is that of tiles.
SparseSums merged(const std::vector<Entry>& entries, int64_t gaussians) {
  std::vector<int64_t> begin(static_cast<size_t>(gaussians) + 1, 0);
  for (const Entry& e : entries) ++begin[static_cast<size_t>(e.gaussian) + 1];
  for (size_t i = 1; i < begin.size(); ++i) begin[i] += begin[i - 1];
  std::vector<std::pair<int32_t, float>> sorted(entries.size());
  {
    std::vector<int64_t> next(begin.begin(), begin.end() - 1);
    for (const Entry& e : entries)
      sorted[static_cast<size_t>(next[static_cast<size_t>(e.gaussian)]++)] = {e.column, e.sum};
  }
  std::vector<int64_t> kept(static_cast<size_t>(gaussians) + 1, 0);
  parallel_for(gaussians, 4096, [&](int64_t from, int64_t to) {
    for (int64_t g = from; g < to; ++g) {
      auto* first = sorted.data() + begin[static_cast<size_t>(g)];
      auto* last = sorted.data() + begin[static_cast<size_t>(g) + 1];
      if (first == last) continue;
      std::stable_sort(first, last, [](const auto& a, const auto& b) { return a.first < b.first; });
      auto* out = first;
      for (auto* e = first + 1; e != last; ++e)
        if (e->first == out->first)
          out->second += e->second;
        else
          *++out = *e;
      kept[static_cast<size_t>(g) + 1] = out + 1 - first;
    }
  });
  for (size_t i = 1; i < kept.size(); ++i) kept[i] += kept[i - 1];
  SparseSums found;
  const size_t total = static_cast<size_t>(kept.back());
  found.gaussians.resize(total);
  found.columns.resize(total);
  found.sums.resize(total);
  parallel_for(gaussians, 4096, [&](int64_t from, int64_t to) {
    for (int64_t g = from; g < to; ++g) {
      const auto* e = sorted.data() + begin[static_cast<size_t>(g)];
      for (size_t at = static_cast<size_t>(kept[static_cast<size_t>(g)]);
           at < static_cast<size_t>(kept[static_cast<size_t>(g) + 1]); ++at, ++e) {
        found.gaussians[at] = g;
        found.columns[at] = e->first;
        found.sums[at] = e->second;
      }
    }
  });
  return found;
}

}  // namespace

SparseSums sparse_adjoint(View& view, const SparseImage& image, int64_t gaussians,
                          float* weights) {
  const Frame& frame = view.frame();
  std::vector<TileColumns> own(static_cast<size_t>(threads()));
  std::vector<std::vector<int32_t>> columns(static_cast<size_t>(view.tiles()));
  std::vector<Entry> entries;
  in_order(
      view.tiles(),
      [&](int thread, int64_t tile, Buffer<float>& rows) {
        TileColumns& mine = own[static_cast<size_t>(thread)];
        const int64_t listed = frame.tile_begin[tile + 1] - frame.tile_begin[tile];
        if (!listed) return;
        mine.read(frame, static_cast<int>(tile), image);
        columns[static_cast<size_t>(tile)] = mine.all;
        const int64_t stride = static_cast<int64_t>(mine.all.size()) + 1;
        kernels().sparse_adjoint(frame, static_cast<int>(tile),
                                 mine.scratch.resize(kTileScratchBytes / 4), mine.image,
                                 mine.chunk_rows.resize(kChunk * static_cast<int64_t>(mine.widest)),
                                 rows.resize(listed * stride), stride);
      },
      [&](int64_t tile, const Buffer<float>& rows) {
        const std::vector<int32_t>& names = columns[static_cast<size_t>(tile)];
        const uint32_t* list = frame.tile_list + frame.tile_begin[tile];
        const int64_t listed = frame.tile_begin[tile + 1] - frame.tile_begin[tile];
        const size_t stride = names.size() + 1;
        for (int64_t k = 0; k < listed; ++k) {
          const float* row = rows.data() + static_cast<size_t>(k) * stride;
          if (!(row[stride - 1] > 0)) continue;
          const int32_t id = frame.splats[list[k]].id;
          weights[id] += row[stride - 1];
          for (size_t c = 0; c + 1 < stride; ++c)
            if (row[c] != 0) entries.push_back({id, names[c], row[c]});
        }
      });
  return merged(entries, gaussians);
}

}  // namespace splatseg
