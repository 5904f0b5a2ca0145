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

static const char PERMISSIONS[] =
    "<dds><permissions><grant name='/c/arm'><subject_name>CN=/c/arm</subject_name>\n"
    "<validity><not_before>2020-01-01T00:00:00</not_before>\n"
    "<not_after>%s-01-01T00:00:00</not_after></validity>\n"
    "<allow_rule><domains><id>0</id></domains>\n"
    "<publish><topics><topic>rt/c/out</topic><topic>rq/c/addRequest</topic></topics></publish>\n"
    "<subscribe><topics><topic>rr/c/addReply</topic></topics></subscribe>\n"
    "</allow_rule><default>DENY</default></grant></permissions></dds>\n";

static void write_permissions(const char *path, const char *year) {
    FILE *file = fopen(path, "w");
    CHECK(file != NULL && fprintf(file, PERMISSIONS, year) > 0 && fclose(file) == 0);
}

void case_permissions(void) {
    char path[] = "/tmp/axon-ffi-permissions-XXXXXX";
    int file = mkstemp(path);
    CHECK(file >= 0 && close(file) == 0);
    axon_session_options_t options;
    OK(axon_session_options_init(&options, AXON_SESSION_ABI));
    CHECK(options.permissions_path == NULL && options.enclave == NULL);
    options.permissions_path = path;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_options_check(&options), "enclave is null");
    options.enclave = "/c/arm";
    axon_session_t session = {7};
    write_permissions(path, "2120");
    options.permissions_path = "\xff";
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_open(&options, &session), "UTF-8");
    options.permissions_path = "/nowhere/permissions.p7s";
    RETURNS(AXON_RET_CONFIG, axon_session_open(&options, &session), "/nowhere/permissions.p7s: ");
    options.permissions_path = path;
    options.enclave = "/c/leg";
    RETURNS(AXON_RET_CONFIG, axon_session_options_check(&options), "CN=/c/leg");
    options.enclave = "/c/arm";
    options.domain = 5;
    RETURNS(AXON_RET_CONFIG, axon_session_open(&options, &session), "nothing in domain 5, but in 0");
    options.domain = 0;
    write_permissions(path, "2021");
    RETURNS(AXON_RET_CONFIG, axon_session_open(&options, &session), "2021-01-01T00:00:00");
    CHECK(session.id == 7);
    write_permissions(path, "2120");
    OK(axon_session_options_check(&options));
    OK(axon_session_open(&options, &session));
    struct place place = {session, {0}};
    OK(axon_session_node_create(session, "node", "/c", "/c/arm", &place.node));
    axon_publisher_t out = publisher(place, "/c/out");
    OK(axon_session_publisher_destroy(out));
    axon_endpoint_options_t service = endpoint("/c/add");
    axon_client_t client = {7};
    OK(axon_session_client_create(place.node, &service, &client));
    OK(axon_session_client_destroy(client));
    axon_server_t server = {7};
    RETURNS(AXON_RET_DENIED, axon_session_server_create(place.node, &service, &server),
            "enclave /c/arm may not subscribe to rq/c/addRequest");
    axon_endpoint_options_t in = endpoint("/c/out");
    axon_subscription_t subscription = {7};
    RETURNS(AXON_RET_DENIED, axon_session_subscription_create(place.node, &in, &subscription), path);
    RETURNS(AXON_RET_DENIED, axon_session_subscription_create(place.node, &in, &subscription),
            "/c/out: enclave /c/arm may not subscribe to rt/c/out: no rule allows it, and line 7");
    CHECK(server.id == 7 && subscription.id == 7);
    close_place(place);
    CHECK(unlink(path) == 0);
}
