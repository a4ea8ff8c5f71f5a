#include "weights.h"

#include <algorithm>
#include <cstring>

#include "pool.h"

namespace splatseg {

void BlockMatrix::build(View& view, int64_t gaussians) {
  const Frame& frame = view.frame();
  width_ = frame.width;
  height_ = frame.height;
  tiles_x_ = frame.tiles_x;
  tiles_y_ = frame.tiles_y;
  gaussians_ = gaussians;
  const int64_t tiles = view.tiles();
  // A tile's entries are not known before it was blended: each thread keeps what it found, and
  // everything moves to its place once all counts are known.
  const size_t parts = static_cast<size_t>(threads());
  std::vector<BlockScratch>& found = view.block_scratch();
  if (found.size() < parts) found.resize(parts);
  for (BlockScratch& each : found) each.ids.set_size(0);
  std::vector<std::pair<int32_t, int64_t>> place(static_cast<size_t>(tiles));
  std::vector<int32_t> counts(static_cast<size_t>(tiles) * 16);
  parallel_for_thread(tiles, 4, [&](int thread, int64_t from, int64_t to) {
    const size_t me = static_cast<size_t>(thread);
    for (int64_t tile = from; tile < to; ++tile) {
      const int64_t room = frame.tile_begin[tile + 1] - frame.tile_begin[tile];
      BlockScratch& mine = found[me];
      int32_t* ids = mine.tile_ids.resize(room * 16);
      uint16_t* weights = mine.tile_weights.resize(room * 256 + 16);
      int32_t* count = counts.data() + tile * 16;
      kernels().block_weights(frame, static_cast<int>(tile),
                              mine.tile.resize(kTileScratchBytes / 4), count, ids, weights, room);
      place[static_cast<size_t>(tile)] = {thread, mine.ids.size()};
      int64_t sum = 0;
      for (int b = 0; b < 16; ++b) sum += count[b];
      mine.ids.reserve(mine.ids.size() + sum);
      mine.weights.reserve((mine.ids.size() + sum) * 16);
      mine.weights.set_size(mine.ids.size() * 16);
      for (int b = 0; b < 16; ++b) {
        const int64_t n = count[b], at = mine.ids.size();
        if (!n) continue;
        std::memcpy(mine.ids.data() + at, ids + b * room, static_cast<size_t>(n) * 4);
        std::memcpy(mine.weights.data() + at * 16, weights + b * room * 16,
                    static_cast<size_t>(n) * 32);
        mine.ids.set_size(at + n);
        mine.weights.set_size((at + n) * 16);
      }
    }
  });
  begin_.resize(static_cast<size_t>(tiles) * 16 + 1);
  int64_t total = 0;
  for (size_t i = 0; i < counts.size(); ++i) {
    begin_[i] = total;
    total += counts[i];
  }
  begin_.back() = total;
  ids_.resize(total);
  weights_.resize(total * 16);
  parallel_for(tiles, 16, [&](int64_t from, int64_t to) {
    for (int64_t tile = from; tile < to; ++tile) {
      const auto [thread, offset] = place[static_cast<size_t>(tile)];
      const BlockScratch& source = found[static_cast<size_t>(thread)];
      const int64_t at = begin_[static_cast<size_t>(tile) * 16];
      const int64_t n = begin_[static_cast<size_t>(tile) * 16 + 16] - at;
      if (!n) continue;
      std::memcpy(ids_.data() + at, source.ids.data() + offset, static_cast<size_t>(n) * 4);
      std::memcpy(weights_.data() + at * 16, source.weights.data() + offset * 16,
                  static_cast<size_t>(n) * 32);
    }
  });
}

void BlockMatrix::render(const float* signal, int channels, int64_t stride, int image_channels,
                         float* image) const {
  std::vector<Buffer<float>> scratch(static_cast<size_t>(threads()));
  parallel_for_thread(
      static_cast<int64_t>(tiles_x_) * tiles_y_ * 16, 64, [&](int thread, int64_t from, int64_t to) {
        float* acc = scratch[static_cast<size_t>(thread)].resize(16 * static_cast<int64_t>(channels));
        for (int64_t block = from; block < to; ++block) {
          const int64_t begin = begin_[static_cast<size_t>(block)];
          kernels().blocks_forward(weights_.data() + begin * 16, ids_.data() + begin,
                                   begin_[static_cast<size_t>(block) + 1] - begin, signal, channels,
                                   stride, acc);
          const int64_t tile = block >> 4, b = block & 15;
          for (int l = 0; l < 16; ++l) {
            const int64_t x = tile % tiles_x_ * kTile + (b & 3) * 4 + (l & 3);
            const int64_t y = tile / tiles_x_ * kTile + (b >> 2) * 4 + (l >> 2);
            if (x < width_ && y < height_)
              std::memcpy(image + (y * width_ + x) * image_channels, acc + l * channels,
                          sizeof(float) * static_cast<size_t>(image_channels));
          }
        }
      });
}

// Threads share the channels: each walks all blocks in order over its own columns, so no sum is
// ever split. Narrow images are one thread's.
void BlockMatrix::back_project(const float* image, int channels, int image_channels, float* sums,
                               int64_t stride, float* weights) const {
  const int groups = channels / 16, parts = std::min(threads(), groups);
  run_on_threads(parts, [&](int part) {
    const int from = groups * part / parts * 16, to = groups * (part + 1) / parts * 16;
    const int mine = to - from, filled = std::max(0, std::min(image_channels, to) - from);
    Buffer<float> block_image;
    float* block = block_image.resize(16 * static_cast<int64_t>(mine));
    std::memset(block, 0, sizeof(float) * 16 * static_cast<size_t>(mine));
    const int64_t blocks = static_cast<int64_t>(tiles_x_) * tiles_y_ * 16;
    for (int64_t i = 0; i < blocks; ++i) {
      const int64_t begin = begin_[static_cast<size_t>(i)];
      const int64_t count = begin_[static_cast<size_t>(i) + 1] - begin;
      if (!count) continue;
      const int64_t tile = i >> 4, b = i & 15;
      for (int l = 0; l < 16; ++l) {
        const int64_t x = tile % tiles_x_ * kTile + (b & 3) * 4 + (l & 3);
        const int64_t y = tile / tiles_x_ * kTile + (b >> 2) * 4 + (l >> 2);
        float* to_block = block + static_cast<int64_t>(l) * mine;
        if (x < width_ && y < height_)
          std::memcpy(to_block, image + (y * width_ + x) * image_channels + from,
                      sizeof(float) * static_cast<size_t>(filled));
        else
          std::memset(to_block, 0, sizeof(float) * static_cast<size_t>(filled));
      }
      kernels().blocks_adjoint(weights_.data() + begin * 16, ids_.data() + begin, count, block, mine,
                               mine, sums + from, stride, part == 0 ? weights : nullptr);
    }
  });
}

void BlockMatrix::count_rows(int64_t* indptr) const {
  indptr[0] = 0;
  const int64_t blocks = static_cast<int64_t>(tiles_x_) * tiles_y_ * 16;
  parallel_for(blocks, 256, [&](int64_t from, int64_t to) {
    for (int64_t i = from; i < to; ++i) {
      int64_t n[16] = {};
      for (int64_t e = begin_[static_cast<size_t>(i)]; e < begin_[static_cast<size_t>(i) + 1]; ++e)
        for (int l = 0; l < 16; ++l) n[l] += weights_[e * 16 + l] != 0;
      const int64_t tile = i >> 4, b = i & 15;
      for (int l = 0; l < 16; ++l) {
        const int64_t x = tile % tiles_x_ * kTile + (b & 3) * 4 + (l & 3);
        const int64_t y = tile / tiles_x_ * kTile + (b >> 2) * 4 + (l >> 2);
        if (x < width_ && y < height_) indptr[y * width_ + x + 1] = n[l];
      }
    }
  });
  const int64_t pixels = static_cast<int64_t>(width_) * height_;
  for (int64_t p = 0; p < pixels; ++p) indptr[p + 1] += indptr[p];
}

void BlockMatrix::fill_rows(const int64_t* indptr, int32_t* ids, uint16_t* weights) const {
  const int64_t blocks = static_cast<int64_t>(tiles_x_) * tiles_y_ * 16;
  parallel_for(blocks, 256, [&](int64_t from, int64_t to) {
    for (int64_t i = from; i < to; ++i) {
      const int64_t tile = i >> 4, b = i & 15;
      int64_t at[16];
      bool inside[16];
      for (int l = 0; l < 16; ++l) {
        const int64_t x = tile % tiles_x_ * kTile + (b & 3) * 4 + (l & 3);
        const int64_t y = tile / tiles_x_ * kTile + (b >> 2) * 4 + (l >> 2);
        inside[l] = x < width_ && y < height_;
        at[l] = inside[l] ? indptr[y * width_ + x] : 0;
      }
      for (int64_t e = begin_[static_cast<size_t>(i)]; e < begin_[static_cast<size_t>(i) + 1]; ++e)
        for (int l = 0; l < 16; ++l)
          if (inside[l] && weights_[e * 16 + l]) {
            ids[at[l]] = ids_[e];
            weights[at[l]++] = weights_[e * 16 + l];
          }
    }
  });
}

namespace {

// What one thread finds in its blocks.
struct PartScratch {
  Buffer<int32_t> ids, sums;
  std::vector<int32_t> part;
  std::vector<int64_t> counts;

  void add(const uint16_t* weights, const int32_t* block_ids, int64_t count, uint32_t lanes,
           int32_t of) {
    const int64_t before = ids.size();
    int32_t* to_ids = ids.reserve(before + count) + before;
    int32_t* to_sums = sums.reserve(before + count) + before;
    kernels().block_sums(weights, count, lanes, to_sums);
    int64_t kept = 0;
    for (int64_t i = 0; i < count; ++i) {
      to_ids[kept] = block_ids[i];
      to_sums[kept] = to_sums[i];
      kept += to_sums[i] != 0;
    }
    ids.set_size(before + kept);
    sums.set_size(before + kept);
    part.push_back(of);
    counts.push_back(kept);
  }
};

}  // namespace

BlockSums BlockMatrix::sums_of_parts(const int32_t* part) const {
  // Blocks in runs: each run is one thread's, and runs are put together in their order.
  constexpr int64_t kRun = 256;
  const int64_t blocks = static_cast<int64_t>(tiles_x_) * tiles_y_ * 16;
  const int64_t runs = (blocks + kRun - 1) / kRun;
  std::vector<PartScratch> found(static_cast<size_t>(threads()));
  struct Place {
    size_t thread;
    size_t row, rows;
    int64_t entry, entries;
  };
  std::vector<Place> places(static_cast<size_t>(runs));
  parallel_for_thread(runs, 1, [&](int thread, int64_t from, int64_t to) {
    PartScratch& mine = found[static_cast<size_t>(thread)];
    for (int64_t run = from; run < to; ++run) {
      Place& place = places[static_cast<size_t>(run)];
      place = {static_cast<size_t>(thread), mine.part.size(), 0, mine.ids.size(), 0};
      for (int64_t i = run * kRun; i < std::min(blocks, (run + 1) * kRun); ++i) {
        const int64_t begin = begin_[static_cast<size_t>(i)];
        const int64_t count = begin_[static_cast<size_t>(i) + 1] - begin;
        if (!count) continue;
        const int64_t tile = i >> 4, b = i & 15;
        int32_t of[16];
        uint32_t left = 0;
        for (int l = 0; l < 16; ++l) {
          const int64_t x = tile % tiles_x_ * kTile + (b & 3) * 4 + (l & 3);
          const int64_t y = tile / tiles_x_ * kTile + (b >> 2) * 4 + (l >> 2);
          of[l] = x < width_ && y < height_ ? part[y * width_ + x] : -1;
          left |= of[l] >= 0 ? 1u << l : 0u;
        }
        while (left) {
          const int32_t next = of[__builtin_ctz(left)];
          uint32_t lanes = 0;
          for (int l = 0; l < 16; ++l) lanes |= of[l] == next ? 1u << l : 0u;
          mine.add(weights_.data() + begin * 16, ids_.data() + begin, count, lanes, next);
          left &= ~lanes;
        }
      }
      place.rows = mine.part.size() - place.row;
      place.entries = mine.ids.size() - place.entry;
    }
  });
  BlockSums all;
  int64_t entries = 0;
  all.indptr.push_back(0);
  for (const Place& place : places) {
    const PartScratch& source = found[place.thread];
    for (size_t row = place.row; row < place.row + place.rows; ++row) {
      all.part.push_back(source.part[row]);
      all.indptr.push_back(all.indptr.back() + source.counts[row]);
    }
    entries += place.entries;
  }
  int32_t* ids = all.ids.resize(entries);
  int32_t* sums = all.sums.resize(entries);
  int64_t at = 0;
  for (const Place& place : places) {
    const PartScratch& source = found[place.thread];
    const size_t bytes = static_cast<size_t>(place.entries) * 4;
    if (!bytes) continue;
    std::memcpy(ids + at, source.ids.data() + place.entry, bytes);
    std::memcpy(sums + at, source.sums.data() + place.entry, bytes);
    at += place.entries;
  }
  return all;
}

PixelRows pixel_rows(View& view, const int64_t* pixels, int64_t count, int64_t k) {
  const Frame& frame = view.frame();
  // Pixels by tile, so that a tile is blended once however many of its pixels are asked for.
  std::vector<int64_t> order(static_cast<size_t>(count));
  std::vector<int32_t> tile_of(static_cast<size_t>(count));
  for (int64_t i = 0; i < count; ++i) {
    order[static_cast<size_t>(i)] = i;
    tile_of[static_cast<size_t>(i)] = static_cast<int32_t>(
        pixels[2 * i + 1] / kTile * frame.tiles_x + pixels[2 * i] / kTile);
  }
  std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) {
    return tile_of[static_cast<size_t>(a)] < tile_of[static_cast<size_t>(b)];
  });
  std::vector<int64_t> starts;
  for (int64_t i = 0; i < count; ++i)
    if (!i || tile_of[static_cast<size_t>(order[static_cast<size_t>(i)])] !=
                  tile_of[static_cast<size_t>(order[static_cast<size_t>(i - 1)])])
      starts.push_back(i);
  starts.push_back(count);

  using Row = std::vector<std::pair<int32_t, float>>;
  std::vector<Row> rows(static_cast<size_t>(count));
  PixelRows out;
  out.first.assign(static_cast<size_t>(count), -1);
  out.median.assign(static_cast<size_t>(count), -1);
  std::vector<Buffer<float>> scratch(static_cast<size_t>(threads()));
  parallel_for_thread(
      static_cast<int64_t>(starts.size()) - 1, 1, [&](int thread, int64_t from, int64_t to) {
        for (int64_t group = from; group < to; ++group) {
          const int64_t begin = starts[static_cast<size_t>(group)];
          const int64_t end = starts[static_cast<size_t>(group) + 1];
          Row blended[16][16];
          uint32_t lanes[16] = {}, blocks = 0;
          auto place = [&](int64_t pixel, int& block, int& lane) {
            const int64_t x = pixels[2 * pixel] % kTile, y = pixels[2 * pixel + 1] % kTile;
            block = static_cast<int>(y / 4 * 4 + x / 4);
            lane = static_cast<int>(y % 4 * 4 + x % 4);
          };
          for (int64_t i = begin; i < end; ++i) {
            int block, lane;
            place(order[static_cast<size_t>(i)], block, lane);
            lanes[block] |= 1u << lane;
            blocks |= 1u << block;
          }
          struct Taker {
            Row (*rows)[16];
            const uint32_t* lanes;
          } taker{blended, lanes};
          kernels().tile_weights(
              frame, tile_of[static_cast<size_t>(order[static_cast<size_t>(begin)])],
              scratch[static_cast<size_t>(thread)].resize(kTileScratchBytes / 4), blocks,
              [](void* self, int block, int32_t id, const float* weights, uint32_t used) {
                Taker& t = *static_cast<Taker*>(self);
                for (uint32_t hit = used & t.lanes[block]; hit; hit &= hit - 1) {
                  const int lane = __builtin_ctz(hit);
                  t.rows[block][lane].emplace_back(id, weights[lane]);
                }
              },
              &taker);
          for (int64_t i = begin; i < end; ++i) {
            const int64_t pixel = order[static_cast<size_t>(i)];
            int block, lane;
            place(pixel, block, lane);
            const Row& row = blended[block][lane];
            Row& kept = rows[static_cast<size_t>(pixel)];
            if (row.empty()) continue;
            out.first[static_cast<size_t>(pixel)] = row.front().first;
            float left = 1;
            for (const auto& [id, weight] : row) {
              left -= weight;
              if (left > kMedian) continue;
              out.median[static_cast<size_t>(pixel)] = id;
              break;
            }
            if (k <= 0 || static_cast<int64_t>(row.size()) <= k) {
              kept = row;
              continue;
            }
            // The k strongest, ties to the front, kept front to back.
            std::vector<int64_t> rank(row.size());
            for (size_t j = 0; j < rank.size(); ++j) rank[j] = static_cast<int64_t>(j);
            std::stable_sort(rank.begin(), rank.end(), [&](int64_t a, int64_t b) {
              return row[static_cast<size_t>(a)].second > row[static_cast<size_t>(b)].second;
            });
            rank.resize(static_cast<size_t>(k));
            std::sort(rank.begin(), rank.end());
            for (int64_t j : rank) kept.push_back(row[static_cast<size_t>(j)]);
          }
        }
      });
  out.indptr.resize(static_cast<size_t>(count) + 1, 0);
  for (size_t i = 0; i < rows.size(); ++i)
    out.indptr[i + 1] = out.indptr[i] + static_cast<int64_t>(rows[i].size());
  out.ids.reserve(static_cast<size_t>(out.indptr.back()));
  out.weights.reserve(static_cast<size_t>(out.indptr.back()));
  for (const Row& row : rows)
    for (const auto& [id, weight] : row) {
      out.ids.push_back(id);
      out.weights.push_back(weight);
    }
  return out;
}

}  // namespace splatseg
