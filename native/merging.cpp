// Greedy merging of regions; see merging.h.
#include "merging.h"

#include <algorithm>
#include <cmath>
#include <queue>
#include <tuple>

namespace splatseg {
namespace {

// Columns of the means over a region, after the count of its pixels; _region_graph.py fills them.
constexpr int kSquares = 3, kTexture = 6, kContour = 8, kGradient = 9, kBins = 10;
constexpr int kHistograms[4] = {0, 13, 30, 47};
constexpr int kThing = 57, kBoxes = 58, kBoxSquares = 66;
constexpr double kColourScale = 25.0;

using Box = const double*;

double extent(Box b) { return (b[2] - b[0]) * (b[3] - b[1]); }

double common(Box a, Box b) {
  const double width = std::max(0.0, std::min(a[2], b[2]) - std::max(a[0], b[0]));
  const double height = std::max(0.0, std::min(a[3], b[3]) - std::max(a[1], b[1]));
  return width * height;
}

double iou(Box a, Box b) {
  const double shared = common(a, b);
  return shared / std::max(1.0, extent(a) + extent(b) - shared);
}

double inside(Box a, Box b) { return common(a, b) / std::max(1.0, extent(a)); }

// Spread of predicted boxes within a region, against their size.
double uncertain(const double* mean, int kind) {
  double variance = 0;
  for (int k = 4 * kind; k < 4 * kind + 4; ++k)
    variance += std::max(0.0, mean[kBoxSquares + k] - mean[kBoxes + k] * mean[kBoxes + k]);
  return std::sqrt(variance / 4) / (8 + std::sqrt(std::max(0.0, extent(mean + kBoxes + 4 * kind))));
}

class Merging {
 public:
  Merging(const Regions& regions, const Borders& borders, const Perceptron& perceptron,
          const float* blend, Questions* questions)
      : r_(regions), p_(perceptron), blend_(blend), questions_(questions),
        width_(regions.border_count), neighbours_(static_cast<size_t>(2 * regions.leaves - 1)),
        alive_(static_cast<size_t>(2 * regions.leaves - 1), 0),
        borders_(borders.sums, borders.sums + borders.count * regions.border_count),
        features_(static_cast<size_t>(pair_feature_count(regions))),
        mean_(static_cast<size_t>(regions.sum_count)), other_(mean_) {
    std::fill(alive_.begin(), alive_.begin() + r_.leaves, char{1});
    for (int64_t k = 0; k < borders.count; ++k) {
      const int64_t a = borders.pairs[2 * k], b = borders.pairs[2 * k + 1];
      neighbours_[static_cast<size_t>(a)].push_back({b, k});
      neighbours_[static_cast<size_t>(b)].push_back({a, k});
    }
    for (auto& list : neighbours_) std::sort(list.begin(), list.end());
    size_t widest = features_.size();
    for (const auto& layer : p_.layers) widest = std::max(widest, static_cast<size_t>(layer.out));
    values_.resize(widest);
    next_.resize(widest);
  }

  int64_t run(int64_t* merges, double* costs) {
    for (int64_t a = 0; a < r_.leaves; ++a) ask(a, a);
    int64_t done = 0;
    while (!queue_.empty()) {
      const auto [cost, a, b] = queue_.top();
      queue_.pop();
      if (!alive_[static_cast<size_t>(a)] || !alive_[static_cast<size_t>(b)]) continue;
      const int64_t node = r_.leaves + done;
      merge(a, b, node, cost);
      merges[2 * done] = a;
      merges[2 * done + 1] = b;
      costs[done++] = cost;
      ask(node, -1);
    }
    return done;
  }

 private:
  struct Neighbour {
    int64_t region, border;
    bool operator<(const Neighbour& o) const { return region < o.region; }
  };
  using Entry = std::tuple<double, int64_t, int64_t>;

  double* border(int64_t k) { return borders_.data() + k * width_; }

  // Cost of the pairs of a node with its neighbours above a number.
  void ask(int64_t node, int64_t above) {
    means(node, mean_.data());
    for (const Neighbour& next : neighbours_[static_cast<size_t>(node)]) {
      if (next.region <= above) continue;
      pair_features(node, next);
      if (questions_) {
        questions_->pairs.insert(questions_->pairs.end(), {node, next.region});
        questions_->features.insert(questions_->features.end(), features_.begin(), features_.end());
      }
      queue_.emplace(cost(), std::min(node, next.region), std::max(node, next.region));
    }
  }

  void means(int64_t node, double* out) const {
    const double* sums = r_.sums + node * r_.sum_count;
    for (int64_t k = 1; k < r_.sum_count; ++k) out[k - 1] = sums[k] / sums[0];
  }

  double cost() {
    if (p_.layers.empty()) return features_[0];
    for (size_t k = 0; k < features_.size(); ++k)
      values_[k] = std::clamp((features_[k] - p_.mean[k]) / p_.spread[k], -8.0f, 8.0f);
    for (size_t l = 0; l < p_.layers.size(); ++l) {
      const auto& layer = p_.layers[l];
      float* out = next_.data();
      std::copy(layer.biases, layer.biases + layer.out, out);
      for (int i = 0; i < layer.in; ++i) {
        const float value = l ? std::max(0.0f, values_[static_cast<size_t>(i)])
                              : values_[static_cast<size_t>(i)];
        if (value == 0.0f) continue;
        const float* weights = layer.weights + static_cast<int64_t>(i) * layer.out;
        for (int o = 0; o < layer.out; ++o) out[o] += value * weights[o];
      }
      values_.swap(next_);
    }
    double same = 0;
    for (int o = 0; o < p_.layers.back().out; ++o)
      same += blend_[o] / (1 + std::exp(-static_cast<double>(values_[static_cast<size_t>(o)])));
    return 1 - same;
  }

  void merge(int64_t a, int64_t b, int64_t node, double cost) {
    for (int64_t k = 0; k < r_.sum_count; ++k)
      r_.sums[node * r_.sum_count + k] = r_.sums[a * r_.sum_count + k] + r_.sums[b * r_.sum_count + k];
    r_.rim[node] = r_.rim[a] + r_.rim[b];
    auto& of_a = neighbours_[static_cast<size_t>(a)];
    auto& of_b = neighbours_[static_cast<size_t>(b)];
    const double* between =
        border(std::lower_bound(of_a.begin(), of_a.end(), Neighbour{b, 0})->border);
    for (int64_t k = 0; k < width_; ++k)
      r_.outlines[node * width_ + k] =
          r_.outlines[a * width_ + k] + r_.outlines[b * width_ + k] - 2 * between[k];
    for (int k = 0; k < 2; ++k) {
      r_.boxes[4 * node + k] = std::min(r_.boxes[4 * a + k], r_.boxes[4 * b + k]);
      r_.boxes[4 * node + 2 + k] = std::max(r_.boxes[4 * a + 2 + k], r_.boxes[4 * b + 2 + k]);
    }
    r_.height[node] = std::max({cost, r_.height[a], r_.height[b]});
    auto& joined = neighbours_[static_cast<size_t>(node)];
    auto i = of_a.begin();
    auto j = of_b.begin();
    while (i != of_a.end() || j != of_b.end()) {
      if (i != of_a.end() && i->region == b) { ++i; continue; }
      if (j != of_b.end() && j->region == a) { ++j; continue; }
      const bool first = j == of_b.end() || (i != of_a.end() && i->region <= j->region);
      const bool second = i == of_a.end() || (j != of_b.end() && j->region <= i->region);
      const Neighbour found = first ? *i : *j;
      if (first && second) {
        double* sum = border(found.border);
        const double* more = border(j->border);
        for (int64_t k = 0; k < width_; ++k) sum[k] += more[k];
      }
      if (first) ++i;
      if (second) ++j;
      joined.push_back(found);
      auto& theirs = neighbours_[static_cast<size_t>(found.region)];
      theirs.erase(std::remove_if(theirs.begin(), theirs.end(),
                                  [&](const Neighbour& n) { return n.region == a || n.region == b; }),
                   theirs.end());
      theirs.push_back({node, found.border});  // the largest number yet
    }
    of_a = {};
    of_b = {};
    alive_[static_cast<size_t>(a)] = alive_[static_cast<size_t>(b)] = 0;
    alive_[static_cast<size_t>(node)] = 1;
  }

  void add(double value) { *out_++ = static_cast<float>(value); }
  void add_sorted(double one, double two) {
    add(std::min(one, two));
    add(std::max(one, two));
  }

  // Of a node, whose means are in mean_, and a neighbour: the same whichever comes first.
  void pair_features(int64_t a, const Neighbour& next) {
    const int64_t b = next.region;
    const double* shared = border(next.border);
    means(b, other_.data());
    const double *m = mean_.data(), *o = other_.data();
    const double area = r_.sums[a * r_.sum_count], areas = r_.sums[b * r_.sum_count];
    const double *outline = r_.outlines + a * width_, *outlines = r_.outlines + b * width_;
    const double length = shared[0], least = std::min(area, areas), most = std::max(area, areas);
    const double around = outline[0] + r_.rim[a], arounds = outlines[0] + r_.rim[b];
    const double strong = outline[1] / std::max(1.0, outline[0]);
    const double strongs = outlines[1] / std::max(1.0, outlines[0]);
    Box box = r_.boxes + 4 * a, boxes = r_.boxes + 4 * b;
    const double united[4] = {std::min(box[0], boxes[0]), std::min(box[1], boxes[1]),
                              std::max(box[2], boxes[2]), std::max(box[3], boxes[3])};
    out_ = features_.data();
    for (int64_t k = 1; k < width_; ++k) add(shared[k] / length);
    add(std::log(std::max(1.0, length)) / 6);
    add(length / std::sqrt(least) / 4);
    add(length / std::max(1.0, std::min(around, arounds)));
    add(length / std::max(1.0, std::max(around, arounds)));
    add(std::log(least / r_.pixels) / 8);
    add(std::log(most / r_.pixels) / 8);
    add(std::abs(m[0] - o[0]) / kColourScale);
    add(std::sqrt((m[1] - o[1]) * (m[1] - o[1]) + (m[2] - o[2]) * (m[2] - o[2])) / kColourScale);
    for (int h = 0; h < 3; ++h) {
      double overlap = 0;
      for (int k = kBins + kHistograms[h]; k < kBins + kHistograms[h + 1]; ++k)
        overlap += std::sqrt(m[k] * o[k]);
      add(std::sqrt(std::max(0.0, 1 - overlap)));
    }
    add_sorted(spread(m), spread(o));
    add(std::abs(m[kTexture] - o[kTexture]) + std::abs(m[kTexture + 1] - o[kTexture + 1]));
    add_sorted(m[kTexture] + m[kTexture + 1], o[kTexture] + o[kTexture + 1]);
    add_sorted(m[kContour], o[kContour]);
    add_sorted(m[kGradient], o[kGradient]);
    add_sorted(strong, strongs);
    add((outline[1] + outlines[1] - 2 * shared[1]) /
        std::max(1.0, outline[0] + outlines[0] - 2 * shared[0]));
    add(shared[1] / length - std::min(strong, strongs));
    add(shared[1] / length - std::max(strong, strongs));
    add((around + arounds - 2 * length) / std::sqrt(area + areas) / 8);
    add_sorted(around / std::sqrt(area) / 8, arounds / std::sqrt(areas) / 8);
    add_sorted(area / extent(box), areas / extent(boxes));
    add((area + areas) / extent(united));
    add_sorted(r_.height[a], r_.height[b]);
    add_sorted(r_.rim[a] / std::max(1.0, around), r_.rim[b] / std::max(1.0, arounds));
    if (r_.predicted) predicted_features(area / (area + areas), box, boxes, united);
  }

  // Whether both are things, and how well what is predicted of the one, of the other and of their
  // union fits each other and where they are.
  void predicted_features(double share, Box box, Box boxes, Box united) {
    const double *m = mean_.data(), *o = other_.data();
    add(std::abs(m[kThing] - o[kThing]));
    add_sorted(m[kThing], o[kThing]);
    for (int kind = 0; kind < 2; ++kind) {
      Box one = m + kBoxes + 4 * kind, two = o + kBoxes + 4 * kind;
      double both[4], farthest = 0;
      for (int k = 0; k < 4; ++k) {
        both[k] = share * one[k] + (1 - share) * two[k];
        farthest = std::max(farthest, std::abs(one[k] - two[k]));
      }
      add(iou(one, two));
      add(farthest / (8 + std::sqrt(std::max(0.0, std::min(extent(one), extent(two))))));
      add(iou(both, united));
      add(std::log((extent(united) + 16) / (std::max(0.0, extent(both)) + 16)) / 4);
      add_sorted(iou(one, box), iou(two, boxes));
      add_sorted(inside(box, two), inside(boxes, one));
      add_sorted(uncertain(m, kind), uncertain(o, kind));
    }
  }

  static double spread(const double* mean) {
    double total = 0;
    for (int k = 0; k < 3; ++k)
      total += std::sqrt(std::max(0.0, mean[kSquares + k] - mean[k] * mean[k])) / kColourScale;
    return total;
  }

  const Regions& r_;
  const Perceptron& p_;
  const float* blend_;
  Questions* questions_;
  int64_t width_;
  std::vector<std::vector<Neighbour>> neighbours_;
  std::vector<char> alive_;
  std::vector<double> borders_;
  std::vector<float> features_;
  std::vector<double> mean_, other_;
  std::vector<float> values_, next_;
  float* out_ = nullptr;
  std::priority_queue<Entry, std::vector<Entry>, std::greater<Entry>> queue_;
};

}  // namespace

int64_t pair_feature_count(const Regions& regions) {
  return regions.border_count - 1 + 35 + (regions.predicted ? 23 : 0);
}

int64_t merge_regions(const Regions& regions, const Borders& borders, const Perceptron& perceptron,
                      const float* blend, int64_t* merges, double* costs, Questions* questions) {
  return Merging(regions, borders, perceptron, blend, questions).run(merges, costs);
}

}  // namespace splatseg
