// Calls the core, so that the linker has to find all of it.
#include <axon.h>

extern "C" int linked() {
  axon_session_options_t options;
  axon_session_t session;
  if (axon_session_options_init(&options, AXON_SESSION_ABI) != AXON_RET_OK) {
    return 1;
  }
  return axon_session_open(&options, &session) != AXON_RET_OK || axon_session_close(session) != AXON_RET_OK;
}
