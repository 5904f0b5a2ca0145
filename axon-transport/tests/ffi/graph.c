/* What one asks of the graph. */
#include "check.h"

/* What the visitors have been told, a line each. */
struct told {
    char text[4096];
    size_t count;
};

static void note(struct told *told, const char *text) {
    CHECK(strlen(told->text) + strlen(text) + 1 < sizeof told->text);
    strcat(told->text, text);
    strcat(told->text, " ");
}

static void on_node(void *user, const char *name, const char *namespace_, const char *enclave) {
    struct told *told = user;
    note(told, namespace_);
    note(told, name);
    note(told, enclave);
    told->count++;
}

static void on_name(void *user, const char *name, const char *const *types, size_t type_count) {
    struct told *told = user;
    note(told, name);
    CHECK(type_count > 0);
    for (size_t i = 0; i < type_count; i++) {
        note(told, types[i]);
    }
    told->count++;
}

static void on_endpoint(void *user, const axon_endpoint_t *endpoint) {
    struct told *told = user;
    note(told, endpoint->topic);
    note(told, endpoint->type_name);
    note(told, endpoint->namespace_);
    note(told, endpoint->node);
    CHECK(endpoint->kind == AXON_KIND_PUBLISHER && endpoint->remote == 0);
    CHECK(endpoint->type_hash_size == 3 && memcmp(endpoint->type_hash, "\1\2\3", 3) == 0);
    CHECK(endpoint->qos.reliability == AXON_RELIABILITY_BEST_EFFORT);
    told->count++;
}

/* What names there are. */
static void names(struct place place, uint32_t kinds, const char *node, const char *expected) {
    struct told told = {"", 0};
    OK(axon_session_graph_names(place.session, kinds, node, "/c", on_name, &told));
    if (strcmp(told.text, expected) != 0) {
        fprintf(stderr, "found \"%s\"\n", told.text);
        fail(__FILE__, __LINE__, expected);
    }
}

void case_graph(void) {
    struct place place = open_place("graph");
    axon_node_t second;
    OK(axon_session_node_create(place.session, "second", "/b", "/safe", &second));
    axon_endpoint_options_t options = endpoint("/graph");
    options.type_hash = (const uint8_t *)"\1\2\3";
    options.type_hash_size = 3;
    options.qos.reliability = AXON_RELIABILITY_BEST_EFFORT;
    axon_publisher_t talker;
    axon_subscription_t listener, stranger;
    axon_server_t server;
    axon_client_t client;
    OK(axon_session_publisher_create(place.node, &options, &talker));
    OK(axon_session_subscription_create(place.node, &options, &listener));
    options.type_name = "c/Other";
    OK(axon_session_subscription_create(second, &options, &stranger));
    options = endpoint("/ask");
    OK(axon_session_server_create(place.node, &options, &server));
    OK(axon_session_client_create(second, &options, &client));
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    OK(axon_session_client_wait_available(client, PATIENCE));
    size_t count = 0;
    do {
        OK(axon_session_graph_count(place.session, AXON_KIND_SUBSCRIPTION, "/graph", &count));
    } while (count < 2);
    OK(axon_session_graph_count(place.session, AXON_KIND_PUBLISHER, "/graph", &count));
    CHECK(count == 1);
    OK(axon_session_graph_count(place.session, AXON_KIND_CLIENT, "/graph", &count));
    CHECK(count == 0);

    struct told told = {"", 0};
    OK(axon_session_graph_nodes(place.session, on_node, &told));
    CHECK(told.count == 2 && strcmp(told.text, "/b second /safe /c graph / ") == 0);
    names(place, AXON_KIND_PUBLISHER | AXON_KIND_SUBSCRIPTION, NULL, "/graph c/Other c/Text ");
    names(place, AXON_KIND_PUBLISHER, NULL, "/graph c/Text ");
    names(place, AXON_KIND_SERVER | AXON_KIND_CLIENT, NULL, "/ask c/Text ");
    names(place, AXON_KIND_SERVER, "graph", "/ask c/Text ");
    names(place, AXON_KIND_CLIENT, "graph", "");
    RETURNS(AXON_RET_NO_NODE,
            axon_session_graph_names(place.session, 1, "second", "/c", on_name, &told), "second");
    told.text[0] = 0, told.count = 0;
    OK(axon_session_graph_endpoints(place.session, AXON_KIND_PUBLISHER, "/graph", on_endpoint, &told));
    CHECK(told.count == 1 && strcmp(told.text, "/graph c/Text /c graph ") == 0);

    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_graph_nodes(place.session, NULL, NULL), "null");
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_graph_names(place.session, 0, NULL, NULL, on_name, &told), "kinds");
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_graph_names(place.session, 16, NULL, NULL, on_name, &told), "16");
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_graph_names(place.session, 1, "graph", NULL, on_name, &told), "null");
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_graph_endpoints(place.session, 3, "/graph", on_endpoint, &told), "kind");
    told.text[0] = 0, told.count = 0;
    OK(axon_session_graph_endpoints(place.session, AXON_KIND_PUBLISHER, NULL, on_endpoint, &told));
    CHECK(told.count == 1);
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_graph_endpoints(place.session, 1, NULL, NULL, &told), "null");
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_graph_count(place.session, 1, "/graph", NULL), "null");

    /* Every sample that is to be read here only is acknowledged. */
    OK(axon_session_publisher_publish(talker, NULL, 0, AXON_TIME_NOW, NULL));
    OK(axon_session_publisher_wait_acknowledged(talker, 0));

    OK(axon_session_client_destroy(client));
    OK(axon_session_server_destroy(server));
    OK(axon_session_subscription_destroy(stranger));
    OK(axon_session_subscription_destroy(listener));
    OK(axon_session_publisher_destroy(talker));
    NO_HANDLE(axon_session_publisher_wait_acknowledged(talker, AXON_WAIT_FOREVER));
    OK(axon_session_node_destroy(second));
    axon_session_t gone = place.session;
    close_place(place);
    NO_HANDLE(axon_session_graph_nodes(gone, on_node, &told));
    NO_HANDLE(axon_session_graph_names(gone, 1, NULL, NULL, on_name, &told));
    NO_HANDLE(axon_session_graph_endpoints(gone, 1, "/graph", on_endpoint, &told));
    NO_HANDLE(axon_session_graph_count(gone, 1, "/graph", &count));
}
