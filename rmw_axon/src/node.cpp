// SPDX-License-Identifier: MIT OR Apache-2.0

#include <string>

#include "context.hpp"
#include "error.hpp"
#include "logging.hpp"
#include "rmw/rmw.h"
#include "rmw/validate_namespace.h"
#include "rmw/validate_node_name.h"

namespace rmw_axon
{

Node::Node(rmw_context_t * context, axon_node_t made, axon_guard_t guard)
: handle(made), graph(context, guard)
{
  rmw.implementation_identifier = identifier;
  rmw.data = this;
  rmw.context = context;
}

Node::~Node()
{
  axon_session_node_destroy(handle);
}

Node & node_of(const rmw_node_t * node)
{
  require_object(node, "node");
  return *static_cast<Node *>(node->data);
}

namespace
{

void validate(const char * name, const char * name_space)
{
  int result = RMW_NODE_NAME_VALID;
  if (rmw_validate_node_name(name, &result, nullptr) != RMW_RET_OK) {
    throw Failure(RMW_RET_ERROR, "the node's name could not be validated");
  }
  if (result != RMW_NODE_NAME_VALID) {
    const std::string reason = rmw_node_name_validation_result_string(result);
    throw Failure(RMW_RET_INVALID_ARGUMENT, "node name '" + std::string(name) + "': " + reason);
  }
  result = RMW_NAMESPACE_VALID;
  if (rmw_validate_namespace(name_space, &result, nullptr) != RMW_RET_OK) {
    throw Failure(RMW_RET_ERROR, "the node's namespace could not be validated");
  }
  if (result != RMW_NAMESPACE_VALID) {
    const std::string reason = rmw_namespace_validation_result_string(result);
    throw Failure(RMW_RET_INVALID_ARGUMENT, "namespace '" + std::string(name_space) + "': " + reason);
  }
}

}  // namespace

}  // namespace rmw_axon

using rmw_axon::Node;
using rmw_axon::check;
using rmw_axon::require;

extern "C" {

rmw_node_t * rmw_create_node(rmw_context_t * context, const char * name, const char * namespace_)
{
  return rmw_axon::guarded_pointer(
    [&] {
      rmw_context_impl_t & impl = rmw_axon::usable(context);
      rmw_axon::tell_logger();
      require(name, "name");
      require(namespace_, "namespace_");
      rmw_axon::validate(name, namespace_);
      axon_node_t made{};
      const char * enclave = context->options.enclave;
      check(axon_session_node_create(impl.session, name, namespace_, enclave, &made));
      axon_guard_t guard{};
      const axon_ret_t guarded = axon_session_node_graph_guard(made, &guard);
      if (guarded != AXON_RET_OK) {
        axon_session_node_destroy(made);
        check(guarded);
      }
      auto * node = new Node(context, made, guard);
      node->name = name;
      node->name_space = namespace_;
      node->rmw.name = node->name.c_str();
      node->rmw.namespace_ = node->name_space.c_str();
      return &node->rmw;
    });
}

rmw_ret_t rmw_destroy_node(rmw_node_t * node)
{
  return rmw_axon::guarded([&] {delete &rmw_axon::node_of(node);});
}

const rmw_guard_condition_t * rmw_node_get_graph_guard_condition(const rmw_node_t * node)
{
  return rmw_axon::guarded_pointer(
    [&] {
      const rmw_guard_condition_t * guard = &rmw_axon::node_of(node).graph.rmw;
      return guard;
    });
}

}
