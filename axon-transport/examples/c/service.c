#include <axon.h>
#include <ctype.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct text {
    char bytes[256];
    size_t len;
    axon_message_info_t info;
};

static void check(axon_ret_t ret) {
    if (ret != AXON_RET_OK) {
        fprintf(stderr, "%s\n", axon_session_last_error());
        exit(1);
    }
}

/* Where a message goes that is taken by copying it. */
static uint8_t *room(void *user, size_t len) {
    struct text *text = user;
    text->len = len;
    return len <= sizeof text->bytes ? (uint8_t *)text->bytes : NULL;
}

/* Answers every request with its text in capitals. */
static void serve(axon_session_t session, axon_node_t node, const axon_endpoint_options_t *service) {
    axon_server_t server;
    check(axon_session_server_create(node, service, &server));
    for (;;) {
        axon_server_t ready = server;
        axon_wait_set_t set = {0};
        struct text request;
        uint8_t taken;
        set.servers = &ready;
        set.server_count = 1;
        check(axon_session_wait(session, &set, AXON_WAIT_FOREVER));
        check(axon_session_server_take(server, room, &request, &request.info, &taken));
        if (taken) {
            for (size_t i = 0; i < request.len; i++) {
                request.bytes[i] = (char)toupper((unsigned char)request.bytes[i]);
            }
            check(axon_session_server_respond(server, &request.info.sender,
                                              request.info.publication_sequence,
                                              (uint8_t *)request.bytes, request.len));
        }
    }
}

static void ask(axon_session_t session, axon_node_t node, const axon_endpoint_options_t *service,
                const char *question) {
    axon_client_t client;
    uint8_t taken = 0;
    check(axon_session_client_create(node, service, &client));
    check(axon_session_client_wait_available(client, AXON_WAIT_FOREVER));
    check(axon_session_client_request(client, (const uint8_t *)question, strlen(question), NULL));
    while (!taken) {
        axon_client_t ready = client;
        axon_wait_set_t set = {0};
        struct text response;
        set.clients = &ready;
        set.client_count = 1;
        check(axon_session_wait(session, &set, AXON_WAIT_FOREVER));
        check(axon_session_client_take(client, room, &response, &response.info, &taken));
        if (taken) {
            printf("%.*s\n", (int)response.len, response.bytes);
        }
    }
    check(axon_session_client_destroy(client));
}

int main(int argc, char **argv) {
    axon_session_options_t options;
    axon_endpoint_options_t service = {0};
    axon_session_t session;
    axon_node_t node;
    service.topic = "/capitals";
    service.type_name = "example/Capitals";
    check(axon_session_options_init(&options, AXON_SESSION_ABI));
    check(axon_session_open(&options, &session));
    check(axon_session_node_create(session, argc > 1 ? "asker" : "server", "/", "/", &node));
    if (argc > 1) {
        ask(session, node, &service, argv[1]);
    } else {
        serve(session, node, &service);
    }
    check(axon_session_node_destroy(node));
    check(axon_session_close(session));
    return 0;
}
