#include "view.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "pool.h"

namespace splatseg {
namespace {

constexpr int64_t kBatchBytes = 1 << 22;  // partial sums of a batch of tiles, for each thread
constexpr int64_t kTileScratchFloats = kTileScratchBytes / 4;
constexpr float kUnseen = 0.45f / 255.0f;
constexpr int kMaxDigit = 14;  // bits of a key that one pass of the sort looks at

int64_t split(int64_t count, int part, int parts) { return count * part / parts; }

// Gaussians are shared out in whole pieces: sums over a piece are then the same for any number
// of threads.
constexpr int64_t kPiece = 4096;
int64_t stretch(int64_t count, int64_t part, int64_t parts) {
  const int64_t pieces = (count + kPiece - 1) / kPiece;
  return std::min(count, pieces * part / parts * kPiece);
}

}  // namespace

void View::prepare(const Cloud& cloud, const Pinhole& camera, const Blending& blending) {
  camera_ = camera;
  blending_ = blending;
  frame_.width = camera.width;
  frame_.height = camera.height;
  frame_.tiles_x = (camera.width + kTile - 1) / kTile;
  frame_.tiles_y = (camera.height + kTile - 1) / kTile;
  frame_.alpha_max = blending.alpha_max;

  // Every thread projects a stretch into its own part of one array; the parts keep the order
  // of indices, which a stable sort turns into the order of ties.
  const int parts = threads();
  Splat* all = unsorted_.resize(cloud.count);
  gaussians_ = cloud.count;
  std::vector<int64_t>& found = found_;
  found.assign(static_cast<size_t>(parts), 0);
  run_on_threads(parts, [&](int part) {
    int64_t begin = stretch(cloud.count, part, parts), end = stretch(cloud.count, part + 1, parts);
    found[static_cast<size_t>(part)] =
        kernels().project(cloud, camera, blending, begin, end, all + begin);
  });
  visible_ = 0;
  for (int64_t n : found) visible_ += n;
  uint64_t* keys = keys_.resize(visible_);
  keys_other_.resize(visible_);
  run_on_threads(parts, [&](int part) {
    int64_t to = 0;
    for (int p = 0; p < part; ++p) to += found[static_cast<size_t>(p)];
    const int64_t begin = stretch(cloud.count, part, parts);
    for (int64_t i = 0; i < found[static_cast<size_t>(part)]; ++i) {
      uint32_t bits;
      std::memcpy(&bits, &all[begin + i].depth, 4);
      keys[to + i] = static_cast<uint64_t>(bits) << 32 | static_cast<uint64_t>(begin + i);
    }
  });
  sort_by_depth();
  bin();
  brightest_ = -1;
}

void View::recolour(const Cloud& cloud, int32_t sh_degree) {
  blending_.sh_degree = sh_degree;
  brightest_ = -1;
  parallel_for(visible_, 4096, [&](int64_t begin, int64_t end) {
    kernels().recolour(cloud, camera_, blending_, splats_.data(), begin, end);
  });
}

// Least significant digit first. Depths are positive, so their bits order as they do; above the
// least depth's they are few, and two passes do mostly.
void View::sort_by_depth() {
  const int parts = visible_ > (1 << 15) ? threads() : 1;
  uint64_t *from = keys_.data(), *to = keys_other_.data();
  std::vector<uint32_t> lows(static_cast<size_t>(parts), ~0u), highs(static_cast<size_t>(parts), 0u);
  run_on_threads(parts, [&](int part) {
    uint32_t low = ~0u, high = 0;
    const int64_t end = split(visible_, part + 1, parts);
    for (int64_t i = split(visible_, part, parts); i < end; ++i) {
      const uint32_t depth = static_cast<uint32_t>(from[i] >> 32);
      low = std::min(low, depth);
      high = std::max(high, depth);
    }
    lows[static_cast<size_t>(part)] = low;
    highs[static_cast<size_t>(part)] = high;
  });
  const uint32_t low = *std::min_element(lows.begin(), lows.end());
  const uint32_t high = *std::max_element(highs.begin(), highs.end());
  int width = 0;  // bits of the largest depth above the least
  while (width < 32 && low < high && (high - low) >> width) ++width;
  const int passes = (width + kMaxDigit - 1) / kMaxDigit;
  const int digit = passes ? (width + passes - 1) / passes : 0, buckets = 1 << digit;
  std::vector<uint32_t> counts(static_cast<size_t>(parts) * static_cast<size_t>(buckets));
  for (int pass = 0; pass < passes; ++pass) {
    const int shift = digit * pass;
    const uint32_t mask = static_cast<uint32_t>(buckets - 1);
    auto bucket_of = [=](uint64_t key) {
      return (static_cast<uint32_t>(key >> 32) - low) >> shift & mask;
    };
    std::fill(counts.begin(), counts.end(), 0u);
    run_on_threads(parts, [&](int part) {
      uint32_t* count = counts.data() + static_cast<size_t>(part) * static_cast<size_t>(buckets);
      const int64_t end = split(visible_, part + 1, parts);
      for (int64_t i = split(visible_, part, parts); i < end; ++i) ++count[bucket_of(from[i])];
    });
    uint32_t total = 0;
    for (int bucket = 0; bucket < buckets; ++bucket)
      for (int part = 0; part < parts; ++part) {
        uint32_t& count = counts[static_cast<size_t>(part) * static_cast<size_t>(buckets) +
                                 static_cast<size_t>(bucket)];
        uint32_t n = count;
        count = total;
        total += n;
      }
    run_on_threads(parts, [&](int part) {
      uint32_t* place = counts.data() + static_cast<size_t>(part) * static_cast<size_t>(buckets);
      const int64_t end = split(visible_, part + 1, parts);
      for (int64_t i = split(visible_, part, parts); i < end; ++i)
        to[place[bucket_of(from[i])]++] = from[i];
    });
    std::swap(from, to);
  }
  sorted_keys_ = from;
  Splat* sorted = splats_.resize(visible_);
  const Splat* all = unsorted_.data();
  parallel_for(visible_, 4096, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      if (i + 16 < end) __builtin_prefetch(&all[static_cast<uint32_t>(from[i + 16])]);
      sorted[i] = all[static_cast<uint32_t>(from[i])];
    }
  });
  frame_.splats = sorted;
}

// A stable counting sort of (tile, splat) pairs by tile.
void View::bin() {
  const int parts = threads();
  const int64_t tile_count = tiles();
  if (hits_.size() < static_cast<size_t>(parts)) hits_.resize(static_cast<size_t>(parts));
  tile_counts_.assign(static_cast<size_t>(parts * tile_count), 0);
  run_on_threads(parts, [&](int part) {
    Buffer<uint32_t>& hits = hits_[static_cast<size_t>(part)];
    hits.set_size(0);
    const int64_t end = split(visible_, part + 1, parts);
    for (int64_t at = split(visible_, part, parts); at < end;) {
      hits.reserve(hits.size() + 2 * tile_count + 4096);
      const int64_t room = hits.bytes() / 4 - hits.size();
      hits.set_size(hits.size() + kernels().find_tiles(splats_.data(), at, end, frame_.width,
                                                       frame_.height, hits.data() + hits.size(),
                                                       room, &at));
    }
    int64_t* counts = tile_counts_.data() + part * tile_count;
    for (int64_t i = 0; i < hits.size();) {
      const int64_t stop = i + 1 + hits[i];
      for (++i; i < stop; ++i) ++counts[hits[i]];
    }
  });
  tile_begin_.resize(static_cast<size_t>(tile_count + 1));
  int64_t total = 0;
  for (int64_t tile = 0; tile < tile_count; ++tile) {
    tile_begin_[static_cast<size_t>(tile)] = total;
    for (int part = 0; part < parts; ++part) {
      int64_t& count = tile_counts_[static_cast<size_t>(part * tile_count + tile)];
      const int64_t n = count;
      count = total;
      total += n;
    }
  }
  tile_begin_[static_cast<size_t>(tile_count)] = total;
  uint32_t* list = tile_list_.resize(total);
  run_on_threads(parts, [&](int part) {
    const Buffer<uint32_t>& hits = hits_[static_cast<size_t>(part)];
    int64_t* place = tile_counts_.data() + part * tile_count;
    uint32_t splat = static_cast<uint32_t>(split(visible_, part, parts));
    for (int64_t i = 0; i < hits.size(); ++splat) {
      const int64_t stop = i + 1 + hits[i];
      for (++i; i < stop; ++i) list[place[hits[i]]++] = splat;
    }
  });
  frame_.tile_begin = tile_begin_.data();
  frame_.tile_list = list;
}

template <class Work>
void View::forward_tiles(bool record, int64_t scratch_floats, const Work& work) {
  const size_t parts = static_cast<size_t>(threads());
  if (scratch_.size() < parts) scratch_.resize(parts);
  if (records_.size() < parts) records_.resize(parts);
  for (auto& buffer : records_) buffer.set_size(0);
  record_place_.resize(record ? static_cast<size_t>(tiles()) : 0);
  std::vector<int64_t> evaluated(parts, 0);
  parallel_for_thread(tiles(), 4, [&](int thread, int64_t begin, int64_t end) {
    const size_t me = static_cast<size_t>(thread);
    float* scratch = scratch_[me].resize(kTileScratchFloats + scratch_floats);
    Buffer<uint8_t>& records = records_[me];
    for (int64_t tile = begin; tile < end; ++tile) {
      uint8_t* place = nullptr;
      if (record) {
        const int64_t listed = frame_.tile_begin[tile + 1] - frame_.tile_begin[tile];
        const int64_t chunks = (listed + kChunk - 1) / kChunk;
        records.reserve(records.size() + chunks * 16 * (kChunk + 1) + 1);
        record_place_[static_cast<size_t>(tile)] = {thread, records.size()};
        place = records.data() + records.size();
      }
      const int64_t used = work(static_cast<int>(tile), scratch, place, &evaluated[me]);
      if (record) records.set_size(records.size() + used);
    }
  });
  evaluated_ = 0;
  for (int64_t n : evaluated) evaluated_ += n;
}

float View::brightest() {
  if (brightest_ >= 0) return brightest_;
  const int parts = threads();
  std::vector<float> found(static_cast<size_t>(parts), 0.0f);
  run_on_threads(parts, [&](int part) {
    float most = 0;
    const int64_t end = split(visible_, part + 1, parts);
    for (int64_t i = split(visible_, part, parts); i < end; ++i) {
      const Splat& s = splats_[i];
      most = std::max({most, std::fabs(s.red), std::fabs(s.green), std::fabs(s.blue)});
    }
    found[static_cast<size_t>(part)] = most;
  });
  return brightest_ = *std::max_element(found.begin(), found.end());
}

void View::picture(const uint8_t* tint, uint8_t* image) {
  // What a transmittance T hides is at most T times the largest colour: less than half a level.
  const float enough = kUnseen / std::max(1.0f, brightest());
  if (scratch_.size() < static_cast<size_t>(threads())) scratch_.resize(static_cast<size_t>(threads()));
  parallel_for_thread(tiles(), 4, [&](int thread, int64_t begin, int64_t end) {
    void* scratch = scratch_[static_cast<size_t>(thread)].resize(kTileScratchFloats);
    for (int64_t tile = begin; tile < end; ++tile)
      kernels().picture(frame_, static_cast<int>(tile), scratch, tint, enough, image);
  });
}

void View::forward_colour(int channels, const Planes& out, bool record) {
  forward_tiles(record, 0, [&](int tile, float* scratch, uint8_t* place, int64_t* evaluated) {
    return kernels().forward_colour(frame_, tile, scratch, out.image, channels, out.alpha,
                                    out.depth_sum, out.median, place, evaluated);
  });
}

void View::forward_features(const float* signal, int channels, int64_t stride, int image_channels,
                            const Planes& out, bool record) {
  forward_tiles(record, 256 * static_cast<int64_t>(channels),
                [&](int tile, float* scratch, uint8_t* place, int64_t* evaluated) {
                  return kernels().forward_features(
                      frame_, tile, scratch, signal, channels, stride,
                      scratch + kTileScratchFloats, out.image, image_channels, out.alpha,
                      out.depth_sum, out.median, place, evaluated);
                });
}

// Tiles write partial rows, one for each entry of their list, into a buffer; then the rows are
// added in the order of tiles. The second step is shared by ranges of splats: a tile's list
// ascends, so each range is a stretch of it, and no two threads add to the same Gaussian.
template <class Work, class Add>
void View::in_batches(int64_t row_floats, int64_t scratch_floats, const Work& work,
                      const Add& add) {
  const size_t parts = static_cast<size_t>(threads());
  if (scratch_.size() < parts) scratch_.resize(parts);
  const int64_t tile_count = tiles();
  const int64_t budget = kBatchBytes * static_cast<int64_t>(parts) / 4;
  for (int64_t first = 0; first < tile_count;) {
    int64_t last = first + 1;
    const int64_t begin = frame_.tile_begin[first];
    while (last < tile_count && (frame_.tile_begin[last + 1] - begin) * row_floats <= budget) ++last;
    float* rows = batch_.resize((frame_.tile_begin[last] - begin) * row_floats);
    parallel_for_thread(last - first, 1, [&](int thread, int64_t from, int64_t to) {
      float* scratch = scratch_[static_cast<size_t>(thread)].resize(kTileScratchFloats + scratch_floats);
      for (int64_t tile = first + from; tile < first + to; ++tile)
        work(static_cast<int>(tile), scratch,
             rows + (frame_.tile_begin[tile] - begin) * row_floats);
    });
    const int64_t ranges = parts == 1 ? 1 : static_cast<int64_t>(parts) * 4;
    parallel_for(ranges, 1, [&](int64_t range, int64_t) {
      const uint32_t low = static_cast<uint32_t>(visible_ * range / ranges);
      const uint32_t high = static_cast<uint32_t>(visible_ * (range + 1) / ranges);
      for (int64_t tile = first; tile < last; ++tile) {
        const uint32_t* list = frame_.tile_list + frame_.tile_begin[tile];
        const uint32_t* list_end = frame_.tile_list + frame_.tile_begin[tile + 1];
        const uint32_t* at = std::lower_bound(list, list_end, low);
        const float* row = rows + (frame_.tile_begin[tile] - begin + (at - list)) * row_floats;
        for (; at < list_end && *at < high; ++at, row += row_floats) add(*at, row);
      }
    });
    first = last;
  }
}

void View::adjoint(const float* image, int channels, int image_channels, float* sums,
                   int64_t stride, float* weights) {
  const Kernels& kernel = kernels();
  const int64_t image_floats = 256 * static_cast<int64_t>(channels);
  const int64_t chunk_floats = kChunk * static_cast<int64_t>(channels);
  if (threads() == 1) {
    if (scratch_.empty()) scratch_.resize(1);
    float* scratch = scratch_[0].resize(kTileScratchFloats + image_floats + chunk_floats);
    for (int tile = 0; tile < tiles(); ++tile)
      kernel.adjoint(frame_, tile, scratch, image, channels, image_channels,
                     scratch + kTileScratchFloats, scratch + kTileScratchFloats + image_floats,
                     nullptr, 0, sums, stride, weights);
    return;
  }
  // A row is its sums and its weight, padded so that the next row stays aligned. Rows are wide:
  // they are added while they are still in cache, tile after tile, rather than batch by batch.
  const int64_t row_floats = channels + 16;
  if (scratch_.size() < static_cast<size_t>(threads())) scratch_.resize(static_cast<size_t>(threads()));
  in_order(
      tiles(),
      [&](int thread, int64_t tile, Buffer<float>& rows) {
        float* scratch = scratch_[static_cast<size_t>(thread)].resize(kTileScratchFloats + image_floats);
        const int64_t listed = frame_.tile_begin[tile + 1] - frame_.tile_begin[tile];
        kernel.adjoint(frame_, static_cast<int>(tile), scratch, image, channels, image_channels,
                       scratch + kTileScratchFloats, nullptr, rows.resize(listed * row_floats),
                       row_floats, nullptr, 0, nullptr);
      },
      [&](int64_t tile, const Buffer<float>& rows) {
        const uint32_t* list = frame_.tile_list + frame_.tile_begin[tile];
        const int64_t listed = frame_.tile_begin[tile + 1] - frame_.tile_begin[tile];
        for (int64_t k = 0; k < listed; ++k) {
          const float* row = rows.data() + k * row_floats;
          if (k + 6 < listed) {
            const float* ahead = sums + stride * splats_[list[k + 6]].id;
            for (int c = 0; c < channels; c += 16) __builtin_prefetch(ahead + c, 1);
          }
          if (!(row[channels] > 0)) continue;
          const int64_t id = splats_[list[k]].id;
          weights[id] += row[channels];
          float* to = sums + stride * id;
          for (int c = 0; c < image_channels; ++c) to[c] += row[c];
        }
      });
}

uint8_t* View::record_of(int tile) {
  const RecordPlace& place = record_place_[static_cast<size_t>(tile)];
  return records_[static_cast<size_t>(place.thread)].data() + place.offset;
}

void View::backward_colour(int channels, const ImageGradients& g) {
  float* total = cleared_gradients();
  in_batches(
      kGrad, kChunk * 160,
      [&](int tile, float* scratch, float* rows) {
        kernels().backward_colour(frame_, tile, scratch, record_of(tile), g.image, channels,
                                  g.alpha, g.depth_sum, g.v_image, g.v_alpha, g.v_depth_sum,
                                  scratch + kTileScratchFloats, rows);
      },
      [&](uint32_t splat, const float* row) {
        float* to = total + place(splat) * kGrad;
        for (int j = 0; j < kGrad; ++j) to[j] += row[j];
      });
}

void View::backward_features(const float* signal, int channels, int64_t stride,
                             int image_channels, const ImageGradients& g, float* v_signal) {
  float* total = cleared_gradients();
  const int64_t image_floats = 512 * static_cast<int64_t>(channels);
  const int64_t row_floats = v_signal ? channels + 16 : 16;
  in_batches(
      row_floats, image_floats + kChunk * 160,
      [&](int tile, float* scratch, float* rows) {
        // The kernel writes records and rows apart; they travel as one row each.
        const int64_t listed = frame_.tile_begin[tile + 1] - frame_.tile_begin[tile];
        Buffer<float> records, signals;
        float* record = records.resize(listed * kGrad);
        float* row = v_signal ? signals.resize(listed * channels) : nullptr;
        float* block_image = scratch + kTileScratchFloats;
        kernels().backward_features(frame_, tile, scratch, record_of(tile), signal, stride, g.image,
                                    channels, image_channels, g.alpha, g.depth_sum, g.v_image,
                                    g.v_alpha, g.v_depth_sum, block_image,
                                    block_image + image_floats, record, row);
        for (int64_t k = 0; k < listed; ++k) {
          std::memcpy(rows + k * row_floats, record + k * kGrad, sizeof(float) * kGrad);
          if (row)
            std::memcpy(rows + k * row_floats + 16, row + k * channels,
                        sizeof(float) * static_cast<size_t>(channels));
        }
      },
      [&](uint32_t splat, const float* row) {
        float* to = total + place(splat) * kGrad;
        for (int j = 0; j < kGrad; ++j) to[j] += row[j];
        if (!v_signal) return;
        float* feature = v_signal + static_cast<int64_t>(splats_[splat].id) * image_channels;
        for (int c = 0; c < image_channels; ++c) feature[c] += row[16 + c];
      });
}

void View::chain(const Cloud& cloud, const CloudGradients& out, double* pose) const {
  // The pose is one sum over all Gaussians: pieces, added in order.
  const int64_t pieces = (gaussians_ + kPiece - 1) / kPiece;
  const int64_t parts = static_cast<int64_t>(found_.size());
  const Splat* all = unsorted_.data();
  std::vector<double> partial(pose ? static_cast<size_t>(pieces) * 15 : 0, 0.0);
  auto by_id = [](const Splat& s, int64_t id) { return s.id < id; };
  parallel_for(pieces, 1, [&](int64_t piece, int64_t) {
    double* mine = pose ? partial.data() + piece * 15 : nullptr;
    const int64_t low = piece * kPiece, high = std::min(low + kPiece, gaussians_);
    for (int64_t part = 0; part < parts; ++part) {
      const int64_t first = stretch(gaussians_, part, parts);
      const int64_t next = stretch(gaussians_, part + 1, parts);
      if (next <= low || first >= high) continue;
      const Splat* end = all + first + found_[static_cast<size_t>(part)];
      const int64_t from = std::lower_bound(all + first, end, low, by_id) - all;
      const int64_t to = std::lower_bound(all + first, end, high, by_id) - all;
      kernels().chain(cloud, camera_, blending_, all, gradients_.data(), from, to, out, mine);
    }
  });
  if (!pose) return;
  std::fill(pose, pose + 15, 0.0);
  for (int64_t piece = 0; piece < pieces; ++piece)
    for (int j = 0; j < 15; ++j) pose[j] += partial[static_cast<size_t>(piece * 15 + j)];
}

float* View::cleared_gradients() {
  float* total = gradients_.resize(gaussians_ * kGrad);
  const int parts = static_cast<int>(found_.size());
  run_on_threads(parts, [&](int part) {
    std::memset(total + stretch(gaussians_, part, parts) * kGrad, 0,
                sizeof(float) * static_cast<size_t>(found_[static_cast<size_t>(part)]) * kGrad);
  });
  return total;
}

void View::narrow_signal_gradient(int channels, float* v_signal) const {
  for (int64_t i = 0; i < visible_; ++i)
    for (int c = 0; c < channels; ++c)
      v_signal[static_cast<int64_t>(splats_[i].id) * channels + c] = gradients_[place(i) * kGrad + 6 + c];
}

}  // namespace splatseg
