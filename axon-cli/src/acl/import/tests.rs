//! Tests with documents of SROS2, and with hostile documents.

use axon_transport::access::{AccessRules, Principal, Verb};

use super::{Notes, import};

/// Returns permissions with these rules.
fn permissions(rules: &str, default: &str) -> String {
    format!(
        "<dds><permissions>\n<grant name=\"/arm\">\n<subject_name>CN=/arm</subject_name>\n{rules}\n\
         <default>{default}</default></grant></permissions></dds>"
    )
}

fn rule(kind: &str, publish: &[&str], subscribe: &[&str]) -> String {
    let list = |does: &str, topics: &[&str]| {
        let topics: String =
            topics.iter().map(|topic| format!("<topic>{topic}</topic>\n")).collect();
        format!("<{does}><topics>{topics}</topics></{does}>\n")
    };
    format!(
        "<{kind}_rule>{}{}</{kind}_rule>",
        list("publish", publish),
        list("subscribe", subscribe)
    )
}

/// Returns the text of the rules and the notes.
fn imported(document: &str) -> (String, String) {
    let mut notes = Notes::default();
    let text = import(document, "base", None, &mut notes).unwrap();
    (text, notes.lines().collect::<Vec<_>>().join("\n"))
}

fn refused(document: &str) -> String {
    import(document, "base", None, &mut Notes::default()).unwrap_err()
}

fn may(text: &str, verb: Verb, name: &str) -> bool {
    AccessRules::parse(text, "imported")
        .unwrap()
        .check(Principal::Name("base"), verb, name)
        .allowed()
}

#[test]
fn request_and_response_topics_together_become_a_service_rule() {
    let allow = rule(
        "allow",
        &["rq/addRequest", "rr/homeReply", "rq/half/Request"],
        &["rr/addReply", "rq/homeRequest", "rr/alsoReply"],
    );
    let (text, notes) = imported(&permissions(&allow, "DENY"));
    assert!(text.contains("call = \"/add\"\n") && text.contains("serve = \"/home\"\n"), "{text}");
    assert!(!may(&text, Verb::Call, "/also"));
    assert!(notes.contains("left out \"rq/half/Request\""), "{notes}");
    assert!(notes.contains("\"/also\": of a call it names the responses alone"), "{notes}");
    // A denial of requests or of responses denies the whole service.
    let deny = rule("deny", &["rq/addRequest"], &[]) + &rule("allow", &["*"], &["*"]);
    let (text, notes) = imported(&permissions(&deny, "DENY"));
    assert!(!may(&text, Verb::Call, "/add") && may(&text, Verb::Call, "/other"), "{text}");
    assert!(notes.contains("the whole is denied"), "{notes}");
}

#[test]
fn a_whole_action_and_a_whole_set_of_parameters_are_one_name_each() {
    let of = |before: &str, after: &str, parts: &[&str]| {
        parts.iter().map(|part| format!("{before}{part}{after}")).collect::<Vec<_>>()
    };
    let services =
        ["dock/_action/send_goal", "dock/_action/cancel_goal", "dock/_action/get_result"];
    let parameters = [
        "arm/describe_parameters",
        "arm/get_parameter_types",
        "arm/get_parameters",
        "arm/list_parameters",
        "arm/set_parameters",
        "arm/set_parameters_atomically",
    ];
    let all = [&services[..], &parameters].concat();
    let requests = of("rq/", "Request", &all);
    let mut replies = of("rr/", "Reply", &all);
    replies.extend(of("rt/dock/_action/", "", &["feedback", "status"]));
    replies.push("rt/parameter_events".into());
    let [publish, subscribe] =
        [&requests, &replies].map(|all| all.iter().map(String::as_str).collect::<Vec<_>>());
    let (text, _) = imported(&permissions(&rule("allow", &publish, &subscribe), "DENY"));
    let rules = text.split_once("[[allow]]").unwrap().1;
    assert_eq!(rules, "\npeer = \"base\"\nact = \"/dock\"\nparameters = \"/arm\"\n");
    // The permissions of the server.
    let subscribe = of("rq/", "Request", &services);
    let mut publish = of("rr/", "Reply", &services);
    publish.extend(of("rt/dock/_action/", "", &["feedback", "status"]));
    let [publish, subscribe] =
        [&publish, &subscribe].map(|all| all.iter().map(String::as_str).collect::<Vec<_>>());
    let (text, _) = imported(&permissions(&rule("allow", &publish, &subscribe), "DENY"));
    assert!(text.ends_with("[[allow]]\npeer = \"base\"\nserve = \"/dock\"\n"), "{text}");
}

#[test]
fn a_denial_wins_and_where_dds_decides_otherwise_that_is_said() {
    let allow = rule("allow", &["rt/arm/*"], &[]);
    let deny = rule("deny", &["rt/arm/stop"], &[]);
    for (rules, differs) in [(format!("{deny}{allow}"), false), (format!("{allow}{deny}"), true)] {
        let (text, notes) = imported(&permissions(&rules, "DENY"));
        assert!(!may(&text, Verb::Publish, "/arm/stop") && may(&text, Verb::Publish, "/arm/go"));
        assert_eq!(notes.contains("in DDS the first rule that fits"), differs, "{notes}");
    }
    // The denial and the permission have no name in common.
    let other = rule("deny", &["rt/leg/*"], &["rt/arm/stop"]);
    let (_, notes) = imported(&permissions(&format!("{allow}{other}"), "DENY"));
    assert!(!notes.contains("in DDS the first"), "{notes}");
}

#[test]
fn the_default_counts() {
    let deny = rule("deny", &["rt/stop"], &[]);
    let (text, _) = imported(&permissions(&deny, "ALLOW"));
    assert!(!may(&text, Verb::Publish, "/stop") && may(&text, Verb::Publish, "/go"), "{text}");
    let (text, _) = imported(&permissions("", "DENY"));
    assert!(!may(&text, Verb::Publish, "/go"), "{text}");
    assert!(refused(&permissions("", "ALLOW")).contains("denies nothing"));
    assert!(refused(&permissions("", "allow")).contains("accepted: ALLOW, DENY"));
}

#[test]
fn each_thing_that_cannot_be_honoured_is_named_with_its_line() {
    let rules = "<validity><not_before>2026-01-01T00:00:00</not_before>\
         <not_after>2027-01-01T00:00:00</not_after></validity>\n\
         <allow_rule><domains><id>3</id><id_range><min>7</min><max>9</max></id_range></domains>\n\
         <publish><topics><topic>Square</topic>\n<topic>rt/a?</topic></topics></publish>\n\
         <publish><topics><topic>rt/parted</topic></topics>\
         <partitions><partition>left</partition></partitions></publish>\n\
         <publish><topics><topic>rt/whole</topic></topics>\
         <partitions><partition>*</partition></partitions></publish>\n\
         <relay/><surprise/></allow_rule>";
    let (text, notes) = imported(&permissions(rules, "DENY"));
    for part in [
        "allows more: line 3: \"CN=/arm\" is an enclave's identity",
        "allows more: line 4: valid from 2026-01-01T00:00:00 to 2027-01-01T00:00:00",
        "allows more: line 5: for domains 3, 7 to 9",
        "allows less: line 6: left out \"Square\": not a topic of ROS 2",
        "allows less: line 7: left out \"rt/a?\"",
        "allows less: line 8: topics of a partition",
        "allows less: line 10: relay",
        "element <surprise> is not known",
        "the signature (permissions.p7s) was not verified",
    ] {
        assert!(notes.contains(part), "{part}\n{notes}");
        assert!(text.contains(&format!("# {}", notes.lines().next().unwrap())), "{text}");
    }
    assert!(may(&text, Verb::Publish, "/whole") && !may(&text, Verb::Publish, "/parted"));
    // A denial for a partition denies the topic in all partitions.
    let parted = "<deny_rule><publish><topics><topic>rt/parted</topic></topics>\
         <partitions><partition>left</partition></partitions></publish></deny_rule>";
    let (text, _) = imported(&permissions(parted, "ALLOW"));
    assert!(!may(&text, Verb::Publish, "/parted"));
}

#[test]
fn a_denial_of_all_names_those_without_a_slash_too() {
    let deny = rule("deny", &["*"], &["*"]);
    let (text, _) = imported(&permissions(&deny, "ALLOW"));
    for verb in [Verb::Publish, Verb::Subscribe, Verb::Call, Verb::Serve] {
        assert!(!may(&text, verb, "/a") && !may(&text, verb, "no_slash"), "{verb} {text}");
    }
    // The pattern denies topics of ROS 2 only, whose names all have a leading slash.
    let (text, _) = imported(&permissions(&rule("deny", &["rt/*"], &[]), "ALLOW"));
    assert!(!may(&text, Verb::Publish, "/a") && may(&text, Verb::Publish, "no_slash"), "{text}");
    // A denial of requests needs no denial of responses, and the reverse.
    let deny = rule("deny", &["*", "rq/addRequest"], &["rr/addReply", "*"]);
    let (text, notes) = imported(&permissions(&deny, "ALLOW"));
    assert!(!may(&text, Verb::Call, "/add") && !notes.contains("names the"), "{notes}");
}

#[test]
fn subscribe_permission_for_ros_discovery_info_becomes_see() {
    let (text, _) = imported(&permissions(&rule("allow", &[], &["ros_discovery_info"]), "DENY"));
    assert!(text.contains("see = \"**\"") && !may(&text, Verb::Subscribe, "/a"), "{text}");
    let (text, _) = imported(&permissions(&rule("allow", &["rt/a"], &["rt/b"]), "DENY"));
    assert!(!may(&text, Verb::See, "/a_node"), "{text}");
}

#[test]
fn one_of_several_grants_has_to_be_named() {
    let grant = |name: &str| {
        format!(
            "<grant name=\"{name}\"><subject_name>CN={name},O=x</subject_name>{}<default>DENY</default></grant>",
            rule("allow", &[&format!("rt{name}")], &[])
        )
    };
    let document =
        format!("<dds><permissions>{}{}</permissions></dds>", grant("/arm"), grant("/leg"));
    assert!(refused(&document).contains("name one with --enclave: \"/arm\", \"/leg\""));
    let text = |enclave| import(&document, "base", Some(enclave), &mut Notes::default());
    assert!(may(&text("/leg").unwrap(), Verb::Publish, "/leg"));
    assert!(!may(&text("/leg").unwrap(), Verb::Publish, "/arm"));
    text("CN=/arm,O=x").unwrap();
    assert!(text("/tail").unwrap_err().contains("no grant for that enclave"));
    assert!(refused("<dds><permissions/></dds>").contains("it has no grant"));
}

#[test]
fn a_policy_says_the_same_as_the_permissions_that_sros2_makes_of_it() {
    let policy = "<policy version=\"0.2.0\"><enclaves><enclave path=\"/robot\"><profiles>\n\
         <profile ns=\"/robot\" node=\"arm\">\n\
         <topics publish=\"ALLOW\" subscribe=\"DENY\"><topic>joints</topic><topic>/tf</topic></topics>\n\
         <services request=\"ALLOW\"><service>/home</service></services>\n\
         <services reply=\"ALLOW\"><service>~/get_state</service></services>\n\
         <actions call=\"ALLOW\"><action>grip</action></actions>\n\
         <actions execute=\"ALLOW\"><action>~/move</action></actions>\n\
         </profile></profiles></enclave></enclaves></policy>";
    let (text, notes) = imported(policy);
    let rules = &text[text.find("\n[[deny]]").unwrap()..];
    let expected = "\n[[deny]]\npeer = \"base\"\nsubscribe = [\n  \"/robot/joints\",\n  \"/tf\",\n]\n\n\
         [[allow]]\npeer = \"base\"\npublish = [\n  \"/robot/joints\",\n  \"/tf\",\n]\n\
         serve = [\n  \"/robot/arm/get_state\",\n  \"/robot/arm/move\",\n]\ncall = \"/home\"\n\
         act = \"/robot/grip\"\n";
    assert_eq!(rules, expected);
    assert!(!notes.contains("in DDS the first"), "{notes}");
    let wrong = policy.replace("request=", "publish=");
    assert!(refused(&wrong).contains("line 4: services has no publish"));
    let included =
        policy.replace("<services request=\"ALLOW\">", "<xi:include href=\"/etc/passwd\"/>$0");
    assert!(refused(&included).contains("not XML"), "the prefix is not declared");
    let included = policy
        .replace("<policy", "<policy xmlns:xi=\"http://www.w3.org/2001/XInclude\"")
        .replace("<profile ns", "<xi:include href=\"/etc/passwd\"/><profile ns");
    assert!(refused(&included).contains("includes other files"));
}

#[test]
fn a_signed_document_says_the_same_with_the_lines_of_its_file() {
    let plain = permissions(&rule("allow", &["rt/a?"], &["rt/b"]), "DENY");
    let signed = format!(
        "MIME-Version: 1.0\nContent-Type: multipart/signed; boundary=\"--x\"\n\n----x\n\
         Content-Type: text/plain\r\n\r\n{plain}\n----x\nContent-Type: application/x-pkcs7-signature\n\n\
         MII=\n\n----x--\n"
    );
    let ((text, notes), (same, moved)) = (imported(&plain), imported(&signed));
    let rules = |text: &str| text.split_once("\n[[").unwrap().1.to_owned();
    assert_eq!(rules(&text), rules(&same));
    assert!(notes.contains("line 4: left out \"rt/a?\""), "{notes}");
    assert!(moved.contains("line 10: left out \"rt/a?\""), "{moved}");
    assert!(moved.contains("the signature (permissions.p7s) was not verified"), "{moved}");
}

#[test]
fn invalid_permissions_documents_are_refused_with_a_single_line() {
    let deep = |count: usize| format!("<dds>{}{}</dds>", "<a>".repeat(count), "</a>".repeat(count));
    let attributes: String = (0..100_000).map(|n| format!(" a{n}=\"\"")).collect();
    let spaces: String = (0..40).map(|n| format!(" xmlns:a{n}=\"b\"")).collect();
    let topics = "<topic>rt/a*b*c</topic>".repeat(9_000);
    let many = permissions(
        &format!("<allow_rule><publish><topics>{topics}</topics></publish></allow_rule>"),
        "DENY",
    );
    let bomb = "<!DOCTYPE dds [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;\">]><dds>&b;</dds>";
    let outside = "<!DOCTYPE dds SYSTEM \"file:///etc/passwd\"><dds/>";
    for (document, why) in [
        ("", "not XML"),
        ("[[allow]]", "not XML"),
        ("<dds>", "not XML"),
        ("<dds>&nbsp;</dds>", "not XML"),
        ("<html/>", "its first element is <html>"),
        ("MIME-Version: 1.0\n<dds/>", "its MIME header has no end"),
        (bomb, "it has a DTD"),
        (outside, "it has a DTD"),
        (&deep(20), "deeper than 16"),
        (&deep(100_000), "deeper than 16"),
        (&format!("<dds{attributes}/>"), "a tag of more than"),
        (&format!("<dds{spaces}/>"), "declarations of namespaces"),
        (&many, "more than 8192 expressions"),
    ] {
        let said = refused(document);
        assert!(said.contains(why) && !said.contains('\n'), "{why}: {said}");
    }
}

#[test]
fn names_that_want_out_of_their_string_stay_in_it() {
    let names = [
        ("/a&quot;", "/a\""),
        ("/a&#10;see = 7&#10;peer", "/a\nsee = 7\npeer"),
        ("/a'''&quot;&quot;&quot;", "/a'''\"\"\""),
        ("/a&#x202e;&#x7f;", "/a\u{202e}\u{7f}"),
        ("/<![CDATA[<b>]]>", "/<b>"),
    ];
    for (name, expected) in names {
        let rules = rule("allow", &[&format!("rt{name}"), name], &[]);
        let document =
            permissions(&rules, "DENY").replace("name=\"/arm\"", "name=\"/arm&#10;[[allow]]\"");
        let (text, notes) = imported(&document);
        assert!(may(&text, Verb::Publish, expected), "{text}");
        assert!(!may(&text, Verb::Publish, "/other"), "{text}");
        assert_eq!(text.matches("\n[[allow]]").count(), 1, "{text}");
        assert!(!notes.contains('\u{202e}'), "{notes}");
    }
    let long = format!("rt/{}", "a".repeat(2_000));
    let (_, notes) = imported(&permissions(&rule("allow", &[&long], &[]), "DENY"));
    assert!(notes.contains("at most 1,024 bytes"), "{notes}");
}
