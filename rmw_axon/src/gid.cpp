// SPDX-License-Identifier: MIT OR Apache-2.0

#include "gid.hpp"

#include "endpoint.hpp"
#include "error.hpp"
#include "features.hpp"

namespace rmw_axon
{

rmw_gid_t from_core(const axon_gid_t & gid)
{
  rmw_gid_t made{};
  made.implementation_identifier = identifier;
  copy_gid(gid, made.data);
  return made;
}

}  // namespace rmw_axon

using rmw_axon::guarded;
using rmw_axon::require;

extern "C" {

rmw_ret_t rmw_get_gid_for_publisher(const rmw_publisher_t * publisher, rmw_gid_t * gid)
{
  return guarded(
    [&] {
      const auto & of = rmw_axon::publisher_of(publisher);
      require(gid, "gid");
      *gid = rmw_axon::from_core(of.gid);
    });
}

#if AXON_RMW_IRON
rmw_ret_t rmw_get_gid_for_client(const rmw_client_t * client, rmw_gid_t * gid)
{
  return guarded(
    [&] {
      const auto & of = rmw_axon::client_of(client);
      require(gid, "gid");
      *gid = rmw_axon::from_core(of.gid);
    });
}
#endif

rmw_ret_t rmw_compare_gids_equal(const rmw_gid_t * gid1, const rmw_gid_t * gid2, bool * result)
{
  return guarded(
    [&] {
      rmw_axon::require_object(gid1, "gid1");
      rmw_axon::require_object(gid2, "gid2");
      require(result, "result");
      *result = std::memcmp(gid1->data, gid2->data, sizeof(gid1->data)) == 0;
    });
}

}
