// SPDX-License-Identifier: MIT OR Apache-2.0

// Init options, contexts, and the session of a context.

#include <dlfcn.h>

#include <exception>
#include <memory>
#include <string>
#include <tuple>
#include <vector>

#include "axon.h"
#include "context.hpp"
#include "error.hpp"
#include "features.hpp"
#include "logging.hpp"
#include "rcutils/strdup.h"
#include "rmw/init.h"
#include "rmw/init_options.h"
#include "security.hpp"

namespace
{

using rmw_axon::Failure;
using rmw_axon::check;
using rmw_axon::guarded;
using rmw_axon::require;
using rmw_axon::require_ours;

void require_initialized(const char * implementation_identifier, const char * name)
{
  if (implementation_identifier == nullptr) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, std::string(name) + " is not initialised");
  }
  require_ours(implementation_identifier, name);
}

// lib/rmw_axon/axon_daemon, beside lib/librmw_axon.so which holds this code.
std::string installed_daemon()
{
  Dl_info here{};
  if (dladdr(reinterpret_cast<void *>(&installed_daemon), &here) == 0 || here.dli_fname == nullptr) {
    return {};
  }
  const std::string library = here.dli_fname;
  const size_t slash = library.rfind('/');
  return (slash == std::string::npos ? "." : library.substr(0, slash)) + "/rmw_axon/axon_daemon";
}

// Sets the session's discovery options from the context's options. `peers` owns the array that they point to.
void set_discovery(
  const rmw_init_options_t & options, axon_session_options_t & session,
  std::vector<const char *> & peers)
{
  // rcl has resolved ROS_*. If a program calls rmw without rcl, the library resolves them.
#if AXON_RMW_LOCALHOST_ONLY
  if (options.localhost_only == RMW_LOCALHOST_ONLY_ENABLED) {
    // This setting overrides all that follow.
    session.discovery = AXON_DISCOVERY_LOCALHOST;
    return;
  }
#endif
#if AXON_RMW_IRON
  const rmw_discovery_options_t & discovery = options.discovery_options;
  switch (discovery.automatic_discovery_range) {
    case RMW_AUTOMATIC_DISCOVERY_RANGE_NOT_SET:
      session.discovery = AXON_DISCOVERY_ENVIRONMENT;
      return;
    case RMW_AUTOMATIC_DISCOVERY_RANGE_OFF:
      session.discovery = AXON_DISCOVERY_OFF;
      break;
    case RMW_AUTOMATIC_DISCOVERY_RANGE_LOCALHOST:
      session.discovery = AXON_DISCOVERY_LOCALHOST;
      break;
    case RMW_AUTOMATIC_DISCOVERY_RANGE_SUBNET:
      session.discovery = AXON_DISCOVERY_SUBNET;
      break;
    case RMW_AUTOMATIC_DISCOVERY_RANGE_SYSTEM_DEFAULT:
      session.discovery = AXON_DISCOVERY_SYSTEM_DEFAULT;
      break;
    default:
      throw Failure(RMW_RET_INVALID_ARGUMENT, "options: there is no such discovery range");
  }
  for (size_t i = 0; i < discovery.static_peers_count; ++i) {
    peers.push_back(discovery.static_peers[i].peer_address);
  }
#else
  session.discovery = options.localhost_only == RMW_LOCALHOST_ONLY_DISABLED ?
    AXON_DISCOVERY_SUBNET : AXON_DISCOVERY_ENVIRONMENT;
#endif
  session.static_peers = peers.data();
  session.static_peer_count = peers.size();
}

axon_session_t open_session(const rmw_init_options_t & options)
{
  axon_session_options_t session;
  check(axon_session_options_init(&session, AXON_SESSION_ABI));
  if (options.domain_id != RMW_DEFAULT_DOMAIN_ID) {
    session.domain = options.domain_id < AXON_DOMAIN_ENVIRONMENT ?
      static_cast<uint32_t>(options.domain_id) : AXON_DOMAIN_ENVIRONMENT - 1;
  }
  std::vector<const char *> peers;
  set_discovery(options, session, peers);
  const std::string daemon = installed_daemon();
  session.daemon_path = daemon.empty() ? nullptr : daemon.c_str();
  const rmw_axon::Enclave enclave = rmw_axon::check_security(options, session);
  if (!enclave.permissions_path.empty()) {
    session.permissions_path = enclave.permissions_path.c_str();
    session.enclave = enclave.name.c_str();
  }
  axon_session_t opened{};
  check(axon_session_open(&session, &opened));
  return opened;
}

}  // namespace

namespace rmw_axon
{

rmw_context_impl_t & usable(rmw_context_t * context)
{
  require(context, "context");
  require_initialized(context->implementation_identifier, "context");
  require(context->impl, "context's implementation");
  if (context->impl->is_shutdown) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, "context is shut down");
  }
  return *context->impl;
}

}  // namespace rmw_axon

extern "C" {

rmw_ret_t rmw_init_options_init(rmw_init_options_t * init_options, rcutils_allocator_t allocator)
{
  return guarded(
    [&] {
      require(init_options, "init_options");
      if (!rcutils_allocator_is_valid(&allocator)) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "allocator is not one");
      }
      if (init_options->implementation_identifier != nullptr) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "init_options are initialised already");
      }
      *init_options = rmw_get_zero_initialized_init_options();
      init_options->implementation_identifier = rmw_axon::identifier;
      init_options->allocator = allocator;
      init_options->domain_id = RMW_DEFAULT_DOMAIN_ID;
      init_options->security_options = rmw_get_default_security_options();
#if AXON_RMW_LOCALHOST_ONLY
      init_options->localhost_only = RMW_LOCALHOST_ONLY_DEFAULT;
#endif
    });
}

rmw_ret_t rmw_init_options_copy(const rmw_init_options_t * src, rmw_init_options_t * dst)
{
  return guarded(
    [&] {
      require(src, "src");
      require(dst, "dst");
      require_initialized(src->implementation_identifier, "src");
      if (dst->implementation_identifier != nullptr) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "dst is initialised already");
      }
      rcutils_allocator_t allocator = src->allocator;
      if (!rcutils_allocator_is_valid(&allocator)) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "src's allocator is not one");
      }
      rmw_init_options_t copy = *src;
      copy.enclave = rcutils_strdup(src->enclave, allocator);
      if (src->enclave != nullptr && copy.enclave == nullptr) {
        throw std::bad_alloc();
      }
      copy.security_options = rmw_get_zero_initialized_security_options();
      rmw_ret_t copied =
      rmw_security_options_copy(&src->security_options, &allocator, &copy.security_options);
#if AXON_RMW_IRON
      copy.discovery_options = rmw_get_zero_initialized_discovery_options();
      if (copied == RMW_RET_OK) {
        rmw_discovery_options_t from = src->discovery_options;
        copied = rmw_discovery_options_copy(&from, &allocator, &copy.discovery_options);
      }
#endif
      if (copied != RMW_RET_OK) {
        std::ignore = rmw_init_options_fini(&copy);
        throw Failure(copied, "init options could not be copied");
      }
      *dst = copy;
    });
}

rmw_ret_t rmw_init_options_fini(rmw_init_options_t * init_options)
{
  return guarded(
    [&] {
      require(init_options, "init_options");
      require_initialized(init_options->implementation_identifier, "init_options");
      rcutils_allocator_t allocator = init_options->allocator;
      if (!rcutils_allocator_is_valid(&allocator)) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "init_options' allocator is not one");
      }
      allocator.deallocate(init_options->enclave, allocator.state);
      rmw_ret_t ended = rmw_security_options_fini(&init_options->security_options, &allocator);
#if AXON_RMW_IRON
      const rmw_ret_t discovery = rmw_discovery_options_fini(&init_options->discovery_options);
      ended = ended == RMW_RET_OK ? discovery : ended;
#endif
      *init_options = rmw_get_zero_initialized_init_options();
      if (ended != RMW_RET_OK) {
        throw Failure(ended, "init options could not be ended");
      }
    });
}

rmw_ret_t rmw_init(const rmw_init_options_t * options, rmw_context_t * context)
{
  return guarded(
    [&] {
      require(options, "options");
      require(context, "context");
      require_initialized(options->implementation_identifier, "options");
      require(options->enclave, "options' enclave");
      if (context->implementation_identifier != nullptr) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "context is initialised already");
      }
      auto impl = std::make_unique<rmw_context_impl_t>();
      rmw_axon::start_logging();
      try {
        impl->session = open_session(*options);
      } catch (const std::exception &) {
        rmw_axon::tell_logger();
        throw;
      }
      uint32_t domain = 0;
      rmw_init_options_t kept = rmw_get_zero_initialized_init_options();
      rmw_ret_t copied = RMW_RET_ERROR;
      if (axon_session_domain(impl->session, &domain) == AXON_RET_OK) {
        copied = rmw_init_options_copy(options, &kept);
      }
      if (copied != RMW_RET_OK) {
        axon_session_close(impl->session);
        throw Failure(copied, "options could not be copied");
      }
      context->instance_id = options->instance_id;
      context->implementation_identifier = rmw_axon::identifier;
      context->actual_domain_id = domain;
      context->options = kept;
      context->impl = impl.release();
    });
}

rmw_ret_t rmw_shutdown(rmw_context_t * context)
{
  return guarded(
    [&] {
      require(context, "context");
      require_initialized(context->implementation_identifier, "context");
      require(context->impl, "context's implementation");
      context->impl->is_shutdown = true;
      // This opens the log if the context never had a node.
      rmw_axon::tell_logger();
    });
}

rmw_ret_t rmw_context_fini(rmw_context_t * context)
{
  return guarded(
    [&] {
      require(context, "context");
      require_initialized(context->implementation_identifier, "context");
      require(context->impl, "context's implementation");
      if (!context->impl->is_shutdown) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "context is not shut down");
      }
      // The result is ignored: the session of a forked child belongs to its parent, which closes it.
      axon_session_close(context->impl->session);
      delete context->impl;
      const rmw_ret_t ended = rmw_init_options_fini(&context->options);
      *context = rmw_get_zero_initialized_context();
      if (ended != RMW_RET_OK) {
        throw Failure(ended, "context's options could not be ended");
      }
    });
}

}
