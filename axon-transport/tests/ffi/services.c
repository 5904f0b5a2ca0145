/* Services and clients. */
#include "check.h"

static int take_request(axon_server_t server, struct message *message) {
    uint8_t taken = 7;
    OK(axon_session_server_take(server, room, message, &message->info, &taken));
    return taken;
}

static int take_response(axon_client_t client, struct message *message) {
    uint8_t taken = 7;
    OK(axon_session_client_take(client, room, message, &message->info, &taken));
    return taken;
}

static void add(const void *user, size_t count) {
    *(size_t *)user += count;
}

void case_services(void) {
    struct place place = open_place("services");
    struct place other = open_place("clients");
    axon_endpoint_options_t options = endpoint("/add");
    axon_server_t server;
    axon_client_t clients[2];
    size_t matched = 7;
    OK(axon_session_client_create(other.node, &options, &clients[0]));
    OK(axon_session_client_matched(clients[0], &matched));
    CHECK(matched == 0);
    RETURNS(AXON_RET_TIMEOUT, axon_session_client_wait_available(clients[0], 1), "/add");
    close_place(other);

    /* Sessions of one process without a daemon do not meet: the clients are in the server's. */
    OK(axon_session_client_destroy(clients[0]));
    OK(axon_session_server_create(place.node, &options, &server));
    OK(axon_session_client_create(place.node, &options, &clients[0]));
    OK(axon_session_client_create(place.node, &options, &clients[1]));
    axon_gid_t gids[3];
    axon_qos_t qos;
    OK(axon_session_server_describe(server, &gids[2], &qos));
    CHECK(qos.reliability == AXON_RELIABILITY_RELIABLE && qos.depth == 10);
    for (int i = 0; i < 2; i++) {
        OK(axon_session_client_wait_available(clients[i], PATIENCE));
        OK(axon_session_client_describe(clients[i], &gids[i], &qos));
        CHECK(qos.history == AXON_HISTORY_KEEP_LAST);
    }
    do {
        OK(axon_session_server_matched(server, &matched));
    } while (matched < 2);

    struct message message;
    CHECK(!take_request(server, &message));
    CHECK(!take_response(clients[0], &message));
    uint64_t first = 0, second = 0;
    OK(axon_session_client_request(clients[0], (const uint8_t *)"1+2", 3, &first));
    OK(axon_session_client_request(clients[0], (const uint8_t *)"3+4", 3, &second));
    CHECK(first == 1 && second == 2);

    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    axon_server_t asked = server;
    axon_client_t answered[2] = {clients[0], clients[1]};
    set.servers = &asked;
    set.server_count = 1;
    set.clients = answered;
    set.client_count = 2;
    OK(axon_session_wait(place.session, &set, PATIENCE));
    CHECK(asked.id == server.id && answered[0].id == 0 && answered[1].id == 0);

    CHECK(take_request(server, &message));
    CHECK(message.len == 3 && memcmp(message.bytes, "1+2", 3) == 0);
    CHECK(memcmp(&message.info.sender, &gids[0], sizeof gids[0]) == 0);
    CHECK(message.info.publication_sequence == first && message.info.own_session == 1);
    axon_sample_t sample;
    const uint8_t *data;
    size_t len;
    axon_message_info_t info;
    OK(axon_session_server_take_sample(server, &sample, &data, &len, &info));
    CHECK(len == 3 && memcmp(data, "3+4", 3) == 0 && info.publication_sequence == second);
    OK(axon_session_sample_release(sample));

    /* In whatever order, to nobody but who asked. */
    OK(axon_session_server_respond(server, &gids[0], second, (const uint8_t *)"7", 1));
    OK(axon_session_server_respond_at(server, &gids[0], first, 77, (const uint8_t *)"3", 1));
    asked.id = 0, answered[0] = clients[0], answered[1] = clients[1];
    OK(axon_session_wait(place.session, &set, PATIENCE));
    CHECK(answered[0].id == clients[0].id && answered[1].id == 0);
    size_t told = 0;
    OK(axon_session_client_set_callback(clients[0], add, &told));
    CHECK(told == 2);
    OK(axon_session_client_set_callback(clients[0], NULL, NULL));
    CHECK(take_response(clients[0], &message));
    CHECK(message.bytes[0] == '7' && message.info.publication_sequence == second);
    CHECK(message.info.source_timestamp > 77);
    CHECK(memcmp(&message.info.sender, &gids[2], sizeof gids[2]) == 0);
    OK(axon_session_client_take_sample(clients[0], &sample, &data, &len, &info));
    CHECK(len == 1 && data[0] == '3' && info.publication_sequence == first);
    CHECK(info.source_timestamp == 77);
    OK(axon_session_sample_release(sample));
    CHECK(!take_response(clients[0], &message) && !take_response(clients[1], &message));

    told = 0;
    OK(axon_session_client_request(clients[1], NULL, 0, NULL));
    OK(axon_session_server_set_callback(server, add, &told));
    OK(axon_session_server_set_callback(server, NULL, NULL));
    CHECK(told == 1);

    /* One that is gone is answered without an error. */
    OK(axon_session_client_destroy(clients[1]));
    CHECK(take_request(server, &message) && message.len == 0);
    OK(axon_session_server_respond(server, &gids[1], 1, (const uint8_t *)"-", 1));

#define REFUSED(call) RETURNS(AXON_RET_INVALID_ARGUMENT, call, "null")
    uint8_t byte;
    REFUSED(axon_session_server_create(place.node, &options, NULL));
    REFUSED(axon_session_client_create(place.node, &options, NULL));
    REFUSED(axon_session_server_respond(server, NULL, 1, NULL, 0));
    REFUSED(axon_session_server_respond(server, &gids[0], 1, NULL, 1));
    REFUSED(axon_session_server_respond_at(server, NULL, 1, 77, NULL, 0));
    REFUSED(axon_session_server_respond_at(server, &gids[0], 1, 77, NULL, 1));
    REFUSED(axon_session_client_request(clients[0], NULL, 1, NULL));
    REFUSED(axon_session_server_take(server, NULL, NULL, NULL, &byte));
    REFUSED(axon_session_client_take(clients[0], room, &message, NULL, NULL));
    REFUSED(axon_session_server_take_sample(server, &sample, NULL, &len, NULL));
    REFUSED(axon_session_client_take_sample(clients[0], NULL, &data, &len, NULL));
    REFUSED(axon_session_server_matched(server, NULL));
    REFUSED(axon_session_client_matched(clients[0], NULL));

    OK(axon_session_server_destroy(server));
    NO_HANDLE(axon_session_server_destroy(server));
    NO_HANDLE(axon_session_server_respond(server, &gids[0], 1, NULL, 0));
    OK(axon_session_client_destroy(clients[0]));
    NO_HANDLE(axon_session_client_destroy(clients[0]));
    NO_HANDLE(axon_session_client_request(clients[0], NULL, 0, NULL));
    NO_HANDLE(axon_session_server_describe(server, NULL, NULL));
    NO_HANDLE(axon_session_client_describe(clients[0], NULL, NULL));
    NO_HANDLE(axon_session_server_matched(server, &matched));
    NO_HANDLE(axon_session_client_matched(clients[0], &matched));
    NO_HANDLE(axon_session_client_wait_available(clients[0], AXON_WAIT_FOREVER));
    NO_HANDLE(axon_session_server_take(server, room, &message, NULL, &byte));
    NO_HANDLE(axon_session_client_take(clients[0], room, &message, NULL, &byte));
    NO_HANDLE(axon_session_server_take_sample(server, &sample, &data, &len, NULL));
    NO_HANDLE(axon_session_client_take_sample(clients[0], &sample, &data, &len, NULL));
    NO_HANDLE(axon_session_server_set_callback(server, NULL, NULL));
    NO_HANDLE(axon_session_client_set_callback(clients[0], NULL, NULL));
    close_place(place);
}
