/* What the settings say, without a session. */
#include "check.h"

#include <unistd.h>

/* Sets a variable to a new file that only its owner may read. */
static void set_file(const char *variable, char *path) {
    int file = mkstemp(path);
    CHECK(file >= 0 && close(file) == 0);
    CHECK(setenv(variable, path, 1) == 0);
}

void case_authentication(void) {
    axon_session_options_t options;
    OK(axon_session_options_init(&options, AXON_SESSION_ABI));
    uint32_t authentication = 7;
    OK(axon_session_options_authentication(&options, &authentication));
    CHECK(authentication == AXON_AUTHENTICATION_NONE);
    char key[] = "/tmp/axon-ffi-key-XXXXXX", trust[] = "/tmp/axon-ffi-trust-XXXXXX";
    set_file("AXON_CLASSIC_KEY", key);
    authentication = 7;
    RETURNS(AXON_RET_CONFIG, axon_session_options_authentication(&options, &authentication),
            "AXON_CLASSIC_TRUST");
    CHECK(authentication == 7);
    set_file("AXON_CLASSIC_TRUST", trust);
    OK(axon_session_options_authentication(&options, &authentication));
    CHECK(authentication == AXON_AUTHENTICATION_PINNED);
    CHECK(unsetenv("AXON_CLASSIC_TRUST") == 0);
    CHECK(setenv("AXON_CLASSIC_AUTH", "ca", 1) == 0 && setenv("AXON_CLASSIC_CA", trust, 1) == 0);
    CHECK(setenv("AXON_CLASSIC_CERT", trust, 1) == 0);
    OK(axon_session_options_authentication(&options, &authentication));
    CHECK(authentication == AXON_AUTHENTICATION_CA);
    const char *classic[] = {"AUTH", "KEY", "CA", "CERT"};
    for (size_t i = 0; i < sizeof classic / sizeof *classic; i++) {
        char name[32];
        snprintf(name, sizeof name, "AXON_CLASSIC_%s", classic[i]);
        CHECK(unsetenv(name) == 0);
    }
    const char *qkd[][2] = {
        {"AXON_SECURITY_MODE", "qkd"}, {"AXON_QKD_PEERS", "other"}, {"AXON_SAE_ID", "own"},
        {"AXON_SAE_CERT", trust}, {"AXON_SAE_KEY", key}, {"AXON_KME_URL", "https://kme.example"},
        {"AXON_KME_CA", trust},
    };
    for (size_t i = 0; i < sizeof qkd / sizeof *qkd; i++) {
        CHECK(setenv(qkd[i][0], qkd[i][1], 1) == 0);
    }
    OK(axon_session_options_authentication(&options, &authentication));
    CHECK(authentication == AXON_AUTHENTICATION_QKD);
    for (size_t i = 0; i < sizeof qkd / sizeof *qkd; i++) {
        CHECK(unsetenv(qkd[i][0]) == 0);
    }
    CHECK(unlink(key) == 0 && unlink(trust) == 0);
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_options_authentication(&options, NULL), "null");
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_options_authentication(NULL, &authentication),
            "options");
}
