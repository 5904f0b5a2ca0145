// SPDX-License-Identifier: MIT OR Apache-2.0

#include <memory>
#include <string>

#include "cdr/codec.hpp"
#include "endpoint.hpp"
#include "error.hpp"
#include "features.hpp"
#include "gid.hpp"
#include "names.hpp"
#include "qos.hpp"
#include "rmw/rmw.h"
#include "stream.hpp"
#include "trace.hpp"

using rmw_axon::Client;
using rmw_axon::Failure;
using rmw_axon::check;
using rmw_axon::client_of;
using rmw_axon::guarded;
using rmw_axon::require;

extern "C" {

rmw_client_t * rmw_create_client(
  const rmw_node_t * node, const rosidl_service_type_support_t * type_support,
  const char * service_name, const rmw_qos_profile_t * qos_policies)
{
  return rmw_axon::guarded_pointer(
    [&] {
      rmw_axon::Node & of = rmw_axon::node_of(node);
      require(type_support, "type_support");
      require(qos_policies, "qos_policies");
      rmw_axon::EndpointNames names;
      names.name =
      rmw_axon::service_name(service_name, qos_policies->avoid_ros_namespace_conventions);
      auto client = std::make_unique<Client>();
      client->plans = rmw_axon::cdr::plans(type_support);
      names.type = client->plans.type;
      const auto options = rmw_axon::endpoint_options(names, *qos_policies, type_support);
      check(axon_session_client_create(of.handle, &options, &client->handle));
      axon_qos_t qos{};
      check(axon_session_client_describe(client->handle, &client->gid, &qos));
      client->qos = rmw_axon::from_core(qos);
      client->name = service_name;
      client->label = rmw_axon::label("client of service", service_name, of);
      client->rmw.implementation_identifier = rmw_axon::identifier;
      client->rmw.data = client.get();
      client->rmw.service_name = client->name.c_str();
      rmw_axon::trace::client_created(*client);
      return &client.release()->rmw;
    });
}

rmw_ret_t rmw_destroy_client(rmw_node_t * node, rmw_client_t * client)
{
  return guarded(
    [&] {
      rmw_axon::node_of(node);
      delete &client_of(client);
    });
}

rmw_ret_t rmw_send_request(
  const rmw_client_t * client, const void * ros_request, int64_t * sequence_id)
{
  return guarded(
    [&] {
      Client & of = client_of(client);
      require(ros_request, "ros_request");
      require(sequence_id, "sequence_id");
      const rmw_axon::Stream stream(of.plans.request, of.label, ros_request);
      uint64_t sequence = 0;
      check(axon_session_client_request(of.handle, stream.data(), stream.size(), &sequence));
      *sequence_id = static_cast<int64_t>(sequence);
      // The sequence number is known only now, so a server may take the request before this event.
      rmw_axon::trace::send_request(of, ros_request, *sequence_id);
    });
}

rmw_ret_t rmw_take_response(
  const rmw_client_t * client, rmw_service_info_t * request_header, void * ros_response,
  bool * taken)
{
  return guarded(
    [&] {
      Client & of = client_of(client);
      require(request_header, "request_header");
      require(ros_response, "ros_response");
      require(taken, "taken");
      *taken = false;
      rmw_axon::Taken response;
      rmw_axon::trace::Take<Client> traced(of, response, ros_response);
      check(
        axon_session_client_take_sample(
          of.handle, &response.sample, &response.data, &response.size, &response.info));
      if (!response) {
        return;
      }
      rmw_axon::read(of.plans.response, of.label, response, ros_response);
      // The identity of the answered request.
      rmw_axon::copy_gid(of.gid, request_header->request_id.writer_guid);
      request_header->request_id.sequence_number =
      static_cast<int64_t>(response.info.publication_sequence);
      request_header->source_timestamp = response.info.source_timestamp;
      request_header->received_timestamp = response.info.received_timestamp;
      *taken = true;
      traced.delivered();
    });
}

rmw_ret_t rmw_client_request_publisher_get_actual_qos(
  const rmw_client_t * client, rmw_qos_profile_t * qos)
{
  return guarded(
    [&] {
      Client & of = client_of(client);
      require(qos, "qos");
      *qos = of.qos;
    });
}

rmw_ret_t rmw_client_response_subscription_get_actual_qos(
  const rmw_client_t * client, rmw_qos_profile_t * qos)
{
  return rmw_client_request_publisher_get_actual_qos(client, qos);
}

rmw_ret_t rmw_client_set_on_new_response_callback(
  rmw_client_t * client, rmw_event_callback_t callback, const void * user_data)
{
  return guarded(
    [&] {check(axon_session_client_set_callback(client_of(client).handle, callback, user_data));});
}

rmw_ret_t rmw_service_server_is_available(
  const rmw_node_t * node, const rmw_client_t * client, bool * is_available)
{
  return guarded(
    [&] {
      if (node == nullptr || client == nullptr || is_available == nullptr) {
        throw Failure(AXON_RMW_NULL_ARGUMENT, "node, client or is_available is null");
      }
      rmw_axon::node_of(node);
      Client & of = client_of(client);
      size_t servers = 0;
      check(axon_session_client_matched(of.handle, &servers));
      *is_available = servers != 0;
    });
}

}
