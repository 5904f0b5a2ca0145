// SPDX-License-Identifier: MIT OR Apache-2.0

#include <memory>
#include <string>

#include "cdr/codec.hpp"
#include "endpoint.hpp"
#include "error.hpp"
#include "gid.hpp"
#include "names.hpp"
#include "qos.hpp"
#include "rmw/rmw.h"
#include "stream.hpp"
#include "trace.hpp"

using rmw_axon::Failure;
using rmw_axon::Service;
using rmw_axon::check;
using rmw_axon::guarded;
using rmw_axon::require;
using rmw_axon::service_of;

extern "C" {

rmw_service_t * rmw_create_service(
  const rmw_node_t * node, const rosidl_service_type_support_t * type_support,
  const char * service_name, const rmw_qos_profile_t * qos_profile)
{
  return rmw_axon::guarded_pointer(
    [&] {
      rmw_axon::Node & of = rmw_axon::node_of(node);
      require(type_support, "type_support");
      require(qos_profile, "qos_profile");
      rmw_axon::EndpointNames names;
      names.name =
      rmw_axon::service_name(service_name, qos_profile->avoid_ros_namespace_conventions);
      auto service = std::make_unique<Service>();
      service->plans = rmw_axon::cdr::plans(type_support);
      names.type = service->plans.type;
      const auto options = rmw_axon::endpoint_options(names, *qos_profile, type_support);
      check(axon_session_server_create(of.handle, &options, &service->handle));
      axon_qos_t qos{};
      check(axon_session_server_describe(service->handle, nullptr, &qos));
      service->qos = rmw_axon::from_core(qos);
      service->name = service_name;
      service->label = rmw_axon::label("service", service_name, of);
      service->rmw.implementation_identifier = rmw_axon::identifier;
      service->rmw.data = service.get();
      service->rmw.service_name = service->name.c_str();
      return &service.release()->rmw;
    });
}

rmw_ret_t rmw_destroy_service(rmw_node_t * node, rmw_service_t * service)
{
  return guarded(
    [&] {
      rmw_axon::node_of(node);
      delete &service_of(service);
    });
}

rmw_ret_t rmw_take_request(
  const rmw_service_t * service, rmw_service_info_t * request_header, void * ros_request,
  bool * taken)
{
  return guarded(
    [&] {
      Service & of = service_of(service);
      require(request_header, "request_header");
      require(ros_request, "ros_request");
      require(taken, "taken");
      *taken = false;
      rmw_axon::Taken request;
      rmw_axon::trace::Take<Service> traced(of, request, ros_request);
      check(
        axon_session_server_take_sample(
          of.handle, &request.sample, &request.data, &request.size, &request.info));
      if (!request) {
        return;
      }
      rmw_axon::read(of.plans.request, of.label, request, ros_request);
      rmw_axon::copy_gid(request.info.sender, request_header->request_id.writer_guid);
      request_header->request_id.sequence_number =
      static_cast<int64_t>(request.info.publication_sequence);
      request_header->source_timestamp = request.info.source_timestamp;
      request_header->received_timestamp = request.info.received_timestamp;
      *taken = true;
      traced.delivered();
    });
}

rmw_ret_t rmw_send_response(
  const rmw_service_t * service, rmw_request_id_t * request_header, void * ros_response)
{
  return guarded(
    [&] {
      Service & of = service_of(service);
      require(request_header, "request_header");
      require(ros_response, "ros_response");
      const axon_gid_t client = rmw_axon::to_core(request_header->writer_guid);
      const auto sequence = static_cast<uint64_t>(request_header->sequence_number);
      const rmw_axon::Stream stream(of.plans.response, of.label, ros_response);
      const int64_t timestamp =
      rmw_axon::trace::send_response(of, ros_response, client, request_header->sequence_number);
      check(
        axon_session_server_respond_at(
          of.handle, &client, sequence, timestamp, stream.data(), stream.size()));
    });
}

rmw_ret_t rmw_service_request_subscription_get_actual_qos(
  const rmw_service_t * service, rmw_qos_profile_t * qos)
{
  return guarded(
    [&] {
      Service & of = service_of(service);
      require(qos, "qos");
      *qos = of.qos;
    });
}

rmw_ret_t rmw_service_response_publisher_get_actual_qos(
  const rmw_service_t * service, rmw_qos_profile_t * qos)
{
  return rmw_service_request_subscription_get_actual_qos(service, qos);
}

rmw_ret_t rmw_service_set_on_new_request_callback(
  rmw_service_t * service, rmw_event_callback_t callback, const void * user_data)
{
  return guarded(
    [&] {check(axon_session_server_set_callback(service_of(service).handle, callback, user_data));});
}

}
