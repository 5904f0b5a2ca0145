// SPDX-License-Identifier: MIT OR Apache-2.0

// Code that all queries of the graph share.

#ifndef GRAPH_HPP_
#define GRAPH_HPP_

#include <exception>
#include <new>
#include <utility>
#include <vector>

#include "axon.h"
#include "context.hpp"
#include "error.hpp"
#include "rcutils/allocator.h"

namespace rmw_axon
{

// The items that the core passes to a visitor one by one. No exception may leave a visitor: the first one is
// kept, and thrown when the core has returned.
template<typename Item>
struct Seen
{
  std::vector<Item> items;
  std::exception_ptr error;

  template<typename Make>
  static void add(void * user, Make make) noexcept
  {
    auto & seen = *static_cast<Seen *>(user);
    if (seen.error) {
      return;
    }
    try {
      make(seen.items);
    } catch (...) {
      seen.error = std::current_exception();
    }
  }

  std::vector<Item> take()
  {
    if (error) {
      std::rethrow_exception(error);
    }
    return std::move(items);
  }
};

inline axon_session_t session_of(const Node & node)
{
  return node.rmw.context->impl->session;
}

inline void require_allocator(const rcutils_allocator_t * allocator)
{
  require(allocator, "allocator");
  if (!rcutils_allocator_is_valid(allocator)) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, "allocator is not one");
  }
}

inline void require_done(bool done)
{
  if (!done) {
    throw std::bad_alloc();
  }
}

}  // namespace rmw_axon

#endif  // GRAPH_HPP_
