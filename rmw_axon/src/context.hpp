// SPDX-License-Identifier: MIT OR Apache-2.0

// The objects behind a context and a node.

#ifndef CONTEXT_HPP_
#define CONTEXT_HPP_

#include <atomic>
#include <string>

#include "axon.h"
#include "rmw/init.h"
#include "rmw/types.h"

struct rmw_context_impl_s
{
  axon_session_t session{};
  std::atomic<bool> is_shutdown{false};
};

namespace rmw_axon
{

struct GuardCondition
{
  rmw_guard_condition_t rmw{};
  axon_guard_t handle{};

  GuardCondition(rmw_context_t * context, axon_guard_t made);
  ~GuardCondition();
  GuardCondition(const GuardCondition &) = delete;
  GuardCondition & operator=(const GuardCondition &) = delete;
};

struct Node
{
  rmw_node_t rmw{};
  axon_node_t handle{};
  std::string name;
  std::string name_space;
  // Triggered when the graph has changed.
  GuardCondition graph;

  Node(rmw_context_t * context, axon_node_t made, axon_guard_t guard);
  ~Node();
};

// Returns a context that rmw_init made and rmw_shutdown has not yet ended.
rmw_context_impl_t & usable(rmw_context_t * context);

// Returns the node behind rmw's handle, after the checks that every function must make.
Node & node_of(const rmw_node_t * node);

}  // namespace rmw_axon

#endif  // CONTEXT_HPP_
