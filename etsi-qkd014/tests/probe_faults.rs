//! Tests which check of `kme-sim probe` detects which fault. The KMEs are a simulated one with each of its faults, and
//! the one in Python with a changed member or a missing check. Each check fails for at least one of them, and no check
//! fails beside those in the tables.

mod probing;
mod python;

use std::collections::BTreeSet;
use std::path::Path;

use etsi_qkd014::sim::{Fault, Layout, Network, Pki, Site};
use probing::{Env, Probed, env_file, probe};
use python::Server;

/// The beginnings of the rows that fail, or are only tolerated.
type Rows = &'static [&'static str];

const CERTIFICATE: &str = "certificate of the CA given";
const ANSWERED: &str = "status answered 200";
const ACCEPTED: &str = "a status that the client accepts";
const STATUS_OF_NOBODY: &str = "status of an unknown SAE";
const ERROR: &str = "an error: message, and details";
const UNKNOWN_BY_POST: &str = "dec_keys of an unknown key_ID by POST";
const UNKNOWN_BY_GET: &str = "dec_keys of an unknown key_ID by GET";
const UNKNOWN_WORDS: &str = "message \"one or more keys";
const BROKEN_JSON: &str = "dec_keys with broken JSON";
const OTHER_TYPE: &str = "dec_keys with key_IDs of another type";
const NUMBER: &str = "number over max_key_per_request";
const SIZE: &str = "size over max_key_size";
const ODD_SIZE: &str = "size of broken bytes";
const MANDATORY: &str = "unsupported extension_mandatory";
const MANDATORY_WORDS: &str = "message \"not all extension_mandatory";
const SLAVES: &str = "more than max_SAE_ID_count";
const NO_NUMBER: &str = "number of another type";
const NO_NUMBER_IN_URL: &str = "number in the URL";
const KEYS_FOR_NOBODY: &str = "enc_keys for an unknown SAE";
const BY_GET: &str = "enc_keys by GET: 1 key";
const BY_POST: &str = "enc_keys by POST: 3 keys";
const LENGTH: &str = "each key of";
const KEY_IDS: &str = "each key_ID another";
const UUIDS: &str = "each key_ID a UUID";
const TWICE: &str = "no key delivered twice";
const NOT_NAMED: &str = "dec_keys by an SAE that was not named";
const SAME_BY_GET: &str = "dec_keys by GET: the same key";
const SAME_BY_POST: &str = "dec_keys by POST: the same 3 keys";
const AGAIN: &str = "dec_keys of the same key again";

/// The rows that depend on the answer to a request for which no key is given.
const NOTHING_ANSWERED: Rows = &[
    ANSWERED,
    ACCEPTED,
    STATUS_OF_NOBODY,
    UNKNOWN_BY_POST,
    UNKNOWN_BY_GET,
    BROKEN_JSON,
    OTHER_TYPE,
];

/// The same rows if each answer is a refusal, some of which may have any code.
const NOTHING_SERVED: Rows =
    &[ANSWERED, ACCEPTED, UNKNOWN_BY_POST, UNKNOWN_BY_GET, BROKEN_JSON, OTHER_TYPE];

/// A fault at the master's KME, or with `slave:` before it at the slave's.
const FAULTS: [(&str, Rows); 43] = [
    ("handshake-refused", &[CERTIFICATE]),
    ("handshake-dropped", &[CERTIFICATE]),
    ("certificate-expired", &[CERTIFICATE]),
    ("certificate-not-yet-valid", &[CERTIFICATE]),
    // The probe ends its checks at a KME that does not answer in time.
    ("silence", &[CERTIFICATE]),
    ("latency=60000", &[CERTIFICATE]),
    ("latency=20", &[]),
    ("drip=50", &[CERTIFICATE]),
    ("empty", NOTHING_SERVED),
    ("busy=1", NOTHING_SERVED),
    ("status=500", NOTHING_SERVED),
    ("reset", NOTHING_ANSWERED),
    ("cut", NOTHING_ANSWERED),
    ("endless", NOTHING_ANSWERED),
    ("lying-length,on=status", &[ANSWERED, ACCEPTED, STATUS_OF_NOBODY]),
    ("status=400,on=status", &[ANSWERED, ACCEPTED, ERROR]),
    ("garbage,on=status", &["a JSON object", ACCEPTED, ERROR]),
    ("media-type,on=status", &["Content-Type application/json", ACCEPTED]),
    ("http-1.0", &["HTTP/1.1", ACCEPTED, BY_GET, BY_POST]),
    // Answered 200 whatever was asked.
    (
        "status=200,on=dec_keys",
        &[UNKNOWN_BY_POST, UNKNOWN_BY_GET, BROKEN_JSON, OTHER_TYPE, NOT_NAMED],
    ),
    (
        "status=200,on=enc_keys",
        &[
            NUMBER,
            SIZE,
            MANDATORY,
            SLAVES,
            NO_NUMBER,
            NO_NUMBER_IN_URL,
            KEYS_FOR_NOBODY,
            BY_GET,
            BY_POST,
        ],
    ),
    // Refused by a code that the specification names nowhere.
    ("status=404,on=status", &[ANSWERED, ACCEPTED]),
    (
        "status=404,on=enc_keys",
        &[ODD_SIZE, MANDATORY, NO_NUMBER, NO_NUMBER_IN_URL, BY_GET, BY_POST],
    ),
    // Refused, and not in the words of the specification.
    ("status=400,on=dec_keys", &[UNKNOWN_WORDS, NOT_NAMED]),
    ("status=400,on=enc_keys", &[ODD_SIZE, MANDATORY_WORDS, BY_GET, BY_POST]),
    ("garbage,on=enc_keys", &[ODD_SIZE, MANDATORY_WORDS, BY_GET, BY_POST]),
    ("media-type,on=enc_keys", &[BY_GET, BY_POST]),
    ("wrong-length,on=enc_keys", &[BY_POST, LENGTH, SAME_BY_GET]),
    ("repeat-key-id,on=enc_keys", &[BY_GET, BY_POST]),
    ("reuse-key-id", &[KEY_IDS, SAME_BY_POST]),
    ("key-missing,on=enc_keys", &[BY_GET, BY_POST]),
    // The letter case of a UUID means nothing (RFC 9562, 4).
    ("upper-case-ids", &[]),
    ("other-ids,on=enc_keys", &[NOT_NAMED, SAME_BY_GET, SAME_BY_POST]),
    ("slave:wrong-length", &[SAME_BY_GET, SAME_BY_POST]),
    ("slave:repeat-key-id", &[SAME_BY_GET, SAME_BY_POST]),
    ("slave:key-missing", &[SAME_BY_GET, SAME_BY_POST]),
    ("slave:upper-case-ids", &[]),
    ("slave:other-ids", &[SAME_BY_GET, SAME_BY_POST]),
    ("slave:garbage", &[SAME_BY_GET, SAME_BY_POST]),
    ("slave:empty", &[SAME_BY_GET, SAME_BY_POST, AGAIN]),
    ("slave:certificate-expired", &[SAME_BY_GET, SAME_BY_POST, AGAIN]),
    ("slave:wrong-key", &[SAME_BY_GET, SAME_BY_POST]),
    ("slave:key-kept", &[AGAIN]),
];

/// Options that make the KME in Python wrong.
const WRONG: [(&[&str], Rows); 11] = [
    (&["--anyone"], &["client without a certificate", "client certificate of another CA"]),
    (&["--old-tls"], &["TLS 1.1 refused"]),
    (
        &[
            "--bend=status.source_KME_ID=\"kme-x\"",
            "--bend=status.master_SAE_ID=\"sae-x\"",
            "--bend=status.slave_SAE_ID=\"sae-x\"",
        ],
        &["source_KME_ID", "master_SAE_ID", "slave_SAE_ID", ACCEPTED],
    ),
    (
        &[
            "--bend=status.min_key_size=353",
            "--bend=status.stored_key_count=100001",
            "--bend=status.max_key_per_request=0",
        ],
        &["min_key_size <=", "stored_key_count <=", "max_key_per_request at least 1"],
    ),
    // It serves less than it says is the least.
    (&["--bend=status.min_key_size=352"], &["size under min_key_size"]),
    (
        &["--bend=status.key_size=\"352\"", "--bend=status.target_KME_ID=7"],
        &["4 IDs, strings", "7 sizes and counts", ACCEPTED],
    ),
    (&["--bend=status.additional=1"], &["no members that are not listed", ACCEPTED]),
    (&["--bend=status.status_extension=[]"], &["status_extension", ACCEPTED]),
    (&["--bend=error.message"], &[ERROR, UNKNOWN_WORDS, ODD_SIZE, MANDATORY_WORDS]),
    // 352 bits, the same each time.
    (
        &[
            "--bend=enc_keys.keys.0.key=\"AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=\"",
        ],
        &[TWICE, SAME_BY_GET, SAME_BY_POST],
    ),
    (
        &["--bend=enc_keys.keys.0.key_ID=\"key-1\""],
        &[BY_GET, BY_POST, KEY_IDS, UUIDS, NOT_NAMED, SAME_BY_GET, SAME_BY_POST],
    ),
];

/// Checks that no KME here fails.
const NOT_SHOWN: [&str; 2] = [
    // A KME without TLS 1.2 and 1.3 fails `CERTIFICATE` first.
    "TLS 1.2 or higher",
    // What an answer to an optional extension may be is wide.
    "unknown extension_optional",
];

fn sites() -> Vec<Site> {
    let site = |kme: &str, ip: [u8; 4], sae: &str| Site {
        kme: kme.to_owned(),
        bind: (ip, 0).into(),
        saes: vec![sae.to_owned()],
    };
    vec![site("kme-a", [127, 0, 0, 1], "sae-a"), site("kme-b", [127, 0, 0, 2], "sae-b")]
}

fn run(dir: &Path, envs: [Env; 2]) -> Probed {
    let slave = env_file(dir, &envs);
    let args = ["--consume-keys", "--slave-env", &slave, "--timeout", "3"];
    probe(&envs[0], &args)
}

async fn simulated(fault: &str) -> Probed {
    let mut builder = Network::builder();
    for site in sites() {
        builder = builder.kme(site.kme, site.bind, site.saes);
    }
    let network = builder.start().await.unwrap();
    let (kme, plan) = match fault.split_once(':') {
        Some((_, plan)) => ("kme-b", plan),
        None => ("kme-a", fault),
    };
    if !plan.is_empty() {
        network.kme(kme).unwrap().plan(plan.parse().unwrap());
    }
    let dir = tempfile::tempdir().unwrap();
    network.write_files(dir.path()).unwrap();
    let envs = ["sae-a", "sae-b"].map(|sae| network.sae(sae).unwrap().env(dir.path()));
    tokio::task::block_in_place(|| run(dir.path(), envs))
}

/// Probes the KME in Python. Returns `None` without Python.
fn in_python(options: &[&str]) -> Option<Probed> {
    let dir = tempfile::tempdir().unwrap();
    let layout = Layout { sites: sites() };
    Pki::create(&layout).unwrap().write(dir.path()).unwrap();
    let listen = ["kme-a=127.0.0.1=sae-a", "kme-b=127.0.0.2=sae-b"];
    let server = Server::wrong(options, dir.path(), 1000, &listen)?;
    let of = |sae: &str| layout.env(dir.path()).into_iter().find(|(id, _)| id == sae).unwrap().1;
    let envs = [("sae-a", "kme-a"), ("sae-b", "kme-b")].map(|(sae, kme)| {
        let mut env = of(sae);
        let url = env.iter_mut().find(|(name, _)| *name == "AXON_KME_URL").unwrap();
        url.1 = server.url(kme).to_owned();
        env
    });
    Some(run(dir.path(), envs))
}

/// Holds a table against its line here; the rows that did not pass.
fn not_passed(what: &str, probed: &Probed, expected: Rows) -> BTreeSet<String> {
    let bad: BTreeSet<_> = ["FAIL", "tolerated"].into_iter().flat_map(|v| probed.with(v)).collect();
    let told = |row: &String| expected.iter().any(|start| row.starts_with(start));
    let beside: Vec<_> = bad.iter().filter(|row| !told(row)).collect();
    let missing = expected.iter().filter(|start| !bad.iter().any(|row| row.starts_with(*start)));
    let missing: Vec<_> = missing.collect();
    assert!(
        beside.is_empty() && missing.is_empty(),
        "{what}: {beside:?} failed too, {missing:?} did not\n{}",
        probed.text
    );
    assert_eq!(probed.passed, expected.is_empty(), "{what}: exit status\n{}", probed.text);
    bad
}

#[tokio::test(flavor = "multi_thread")]
async fn each_check_sees_its_fault_and_no_other_does() {
    let clean = simulated("").await;
    assert!(clean.passed && clean.with("skipped").len() == 1, "{}", clean.text);
    let mut all: BTreeSet<_> = clean.with("pass").into_iter().collect();
    let mut shown = BTreeSet::new();
    for (fault, rows) in FAULTS {
        shown.extend(not_passed(fault, &simulated(fault).await, rows));
    }
    let Some(clean) = in_python(&[]) else { return };
    assert!(clean.passed && clean.with("skipped").is_empty(), "{}", clean.text);
    all.extend(clean.with("pass"));
    for (options, rows) in WRONG {
        let what = options.join(" ");
        shown.extend(not_passed(&what, &in_python(options).unwrap(), rows));
    }
    // The KMEs have key sizes of their own.
    let folded = |row: &String| row.replace("352", "256");
    let shown: BTreeSet<_> = shown.iter().map(folded).collect();
    let all: BTreeSet<_> = all.iter().map(folded).collect();
    let left: Vec<_> = all.difference(&shown).collect();
    assert!(
        left.iter().all(|row| NOT_SHOWN.iter().any(|start| row.starts_with(start))),
        "{left:?}"
    );
    assert_eq!(left.len(), NOT_SHOWN.len(), "{left:?}");
}

/// A KME that knows its peers and its limits may say so by any code.
#[tokio::test(flavor = "multi_thread")]
async fn refusals_with_any_unspecified_status_code_are_noted() {
    for code in [403, 404, 422, 503] {
        let status = simulated(&format!("status={code},on=status")).await;
        assert!(status.with("note").iter().any(|row| row.starts_with(STATUS_OF_NOBODY)));
    }
    // The KME's status is intact, so its limits are known and tested.
    let probed = simulated("status=404,on=enc_keys").await;
    let noted = probed.with("note");
    for row in [NUMBER, SIZE, SLAVES, KEYS_FOR_NOBODY] {
        assert!(noted.iter().any(|noted| noted.starts_with(row)), "{row}: {}", probed.text);
    }
    assert!(probed.text.contains(" noted"), "{}", probed.text);
}

#[test]
fn every_fault_is_in_the_table() {
    // The refusal of a fault lists all that there are.
    let refusal = "none".parse::<Fault>().unwrap_err();
    let (_, names) = refusal.split_once("there are: ").unwrap();
    let name = |text: &str| text.split(['=', ',']).next().unwrap_or_default().trim().to_owned();
    let names: BTreeSet<_> = names.split(", ").map(name).collect();
    let plan = |fault: &str| name(fault.split_once(':').map_or(fault, |(_, plan)| plan));
    let tried: BTreeSet<_> = FAULTS.iter().map(|(fault, _)| plan(fault)).collect();
    assert_eq!(names, tried);
}
