// The kernels of one instruction set, gathered. Compiled once for each.
#include <type_traits>

#include "frame.h"

#define SPLATSEG_TEXT_OF(x) #x
#define SPLATSEG_TEXT(x) SPLATSEG_TEXT_OF(x)

namespace splatseg::SPLATSEG_ISA {

// Declares a kernel with the signature the table asks for; the linker finds its body.
#define SPLATSEG_KERNEL(name) std::remove_pointer_t<decltype(Kernels::name)> name;
SPLATSEG_KERNEL(project)
SPLATSEG_KERNEL(recolour)
SPLATSEG_KERNEL(find_tiles)
SPLATSEG_KERNEL(forward_colour)
SPLATSEG_KERNEL(picture)
SPLATSEG_KERNEL(forward_features)
SPLATSEG_KERNEL(adjoint)
SPLATSEG_KERNEL(backward_colour)
SPLATSEG_KERNEL(backward_features)
SPLATSEG_KERNEL(chain)
SPLATSEG_KERNEL(block_weights)
SPLATSEG_KERNEL(block_sums)
SPLATSEG_KERNEL(blocks_forward)
SPLATSEG_KERNEL(blocks_adjoint)
SPLATSEG_KERNEL(tile_weights)
SPLATSEG_KERNEL(gather_rows)
SPLATSEG_KERNEL(scatter_rows)
SPLATSEG_KERNEL(ids_below)
SPLATSEG_KERNEL(sparse_adjoint)
SPLATSEG_KERNEL(argmax)
SPLATSEG_KERNEL(nearest_points)
SPLATSEG_KERNEL(count_points)
SPLATSEG_KERNEL(points_within)
SPLATSEG_KERNEL(ball_means)
SPLATSEG_KERNEL(mean_distances)
SPLATSEG_KERNEL(points_near)
SPLATSEG_KERNEL(match_panels)
SPLATSEG_KERNEL(row_products)

const Kernels& table() {
  static const Kernels kernels = {SPLATSEG_TEXT(SPLATSEG_ISA), project, recolour, find_tiles, forward_colour,
                                  picture, forward_features, adjoint, backward_colour, backward_features,
                                  chain, block_weights, block_sums, blocks_forward, blocks_adjoint,
                                  tile_weights, gather_rows, scatter_rows, ids_below,
                                  sparse_adjoint, argmax, nearest_points, count_points,
                                  points_within, ball_means, mean_distances, points_near, match_panels,
                                  row_products};
  return kernels;
}

}  // namespace splatseg::SPLATSEG_ISA
