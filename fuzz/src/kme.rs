//! Answers of a KME (ETSI GS QKD 014 clause 6), and the subject of its certificate.

use etsi_qkd014::fuzzing;

/// The first two bytes select quirks, the rest is the body of a status answer.
pub fn status_response(data: &[u8]) -> bool {
    fuzzing::status_response(data)
}

/// The first two bytes select quirks, the third the number of keys asked for, the rest is the body.
pub fn key_container(data: &[u8]) -> bool {
    fuzzing::key_container(data)
}

/// The body of an answer other than 200.
pub fn error_response(data: &[u8]) -> bool {
    fuzzing::error_response(data)
}

/// A certificate, or the subject in one.
pub fn certificate_subject(data: &[u8]) -> bool {
    fuzzing::certificate_subject(data)
}

/// Strict, with every quirk, and with what quirks tolerate.
pub fn status_seeds() -> Vec<Vec<u8>> {
    let body = r#"{"source_KME_ID":"kme-a","target_KME_ID":"kme-b","master_SAE_ID":"sae-a","slave_SAE_ID":"sae-b","key_size":256,"stored_key_count":25000,"max_key_count":100000,"max_key_per_request":128,"max_key_size":1024,"min_key_size":64,"max_SAE_ID_count":0}"#;
    let odd = r#"{"SOURCE_kme_id":"kme-\u0061","target_KME_ID":"\ud83d\ude00","master_SAE_ID":"","slave_SAE_ID":"sae-b","key_size":32,"max_key_count":null,"vendor":[[{}],1e3,"\n"],"status_extension":{"a":[null,true,-1.5e-7,{"b":"\/"}]}}"#;
    [(0, body), (0xff, body), (0xff, odd)]
        .into_iter()
        .map(|(quirks, body)| [&[quirks; 2][..], body.as_bytes()].concat())
        .collect()
}

/// The keys that the target asks for by their IDs, keys by number, and what is written otherwise
/// than usual.
pub fn container_seeds() -> Vec<Vec<u8>> {
    const KEY: &str = "QUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUE=";
    let first = format!(r#"{{"key_ID":"bc490419-7d60-487f-adc1-4ddcc177c139","key":"{KEY}"}}"#);
    let second = format!(r#"{{"key_ID":"0A782FB5-3434-48fe-aa4d-14f41d46cf92","key":"{KEY}"}}"#);
    let one = format!(r#"{{"keys":[{first}]}}"#);
    let two = format!(r#"{{"keys":[{first},{second}],"key_container_extension":{{"a":[1]}}}}"#);
    let turned = format!(r#"{{"keys":[{second} , {first}]}}"#);
    let odd = r#"{"Keys":[{"key_extension":null,"KEY":" QUFB\r\n\/\u002bE=","key_ID":"k\u0065y-7","key_ID_extension":{"a":[[]]},"x":{}}],"y":[[1]]}"#;
    [(0, 1, &*one), (0xff, 1, &one), (0, 2, &two), (0, 2, &turned), (0xff, 1, odd)]
        .into_iter()
        .map(|(quirks, number, body)| [&[quirks, quirks, number][..], body.as_bytes()].concat())
        .collect()
}

/// With and without details.
pub fn error_seeds() -> Vec<Vec<u8>> {
    vec![
        br#"{"message":"not all mandatory extensions are supported","details":[{"a":"b"}]}"#.into(),
        br#"{"message":"KME is busy"}"#.into(),
        br#"{"details":[{"a":[{"b":null}]},1e2],"x":{},"message":"\u001b[2J\u202e\ud83d\ude00\n"}"#
            .into(),
    ]
}

/// `CN=kme-a`, in DER.
pub fn subject_seeds() -> Vec<Vec<u8>> {
    vec![b"\x31\x0e\x30\x0c\x06\x03\x55\x04\x03\x0c\x05kme-a".to_vec()]
}
