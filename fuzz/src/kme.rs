//! Answers of a KME (ETSI GS QKD 014 clause 6), and the subject of its certificate.

use etsi_qkd014::fuzzing;

/// The first byte selects quirks, the rest is the body of a status answer.
pub fn status_response(data: &[u8]) -> bool {
    fuzzing::status_response(data)
}

/// The first byte selects quirks, the second the number of keys asked for, the rest is the body.
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

/// Strict, and with every quirk.
pub fn status_seeds() -> Vec<Vec<u8>> {
    let body = br#"{"source_KME_ID":"kme-a","target_KME_ID":"kme-b","master_SAE_ID":"sae-a","slave_SAE_ID":"sae-b","key_size":256,"stored_key_count":25000,"max_key_count":100000,"max_key_per_request":128,"max_key_size":1024,"min_key_size":64,"max_SAE_ID_count":0}"#;
    [0, 0xff].into_iter().map(|quirks| [&[quirks][..], body].concat()).collect()
}

/// The key that the target asks for by its ID, and two keys by number.
pub fn container_seeds() -> Vec<Vec<u8>> {
    const KEY: &str = "QUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUE=";
    let first = format!(r#"{{"key_ID":"bc490419-7d60-487f-adc1-4ddcc177c139","key":"{KEY}"}}"#);
    let second = format!(r#"{{"key_ID":"0a782fb5-3434-48fe-aa4d-14f41d46cf92","key":"{KEY}"}}"#);
    let one = format!(r#"{{"keys":[{first}]}}"#);
    let two = format!(r#"{{"keys":[{first},{second}],"key_container_extension":{{"a":[1]}}}}"#);
    [(0, 1, &one), (0xff, 1, &one), (0, 2, &two)]
        .into_iter()
        .map(|(quirks, number, body)| [&[quirks, number][..], body.as_bytes()].concat())
        .collect()
}

/// With and without details.
pub fn error_seeds() -> Vec<Vec<u8>> {
    vec![
        br#"{"message":"not all mandatory extensions are supported","details":[{"a":"b"}]}"#.into(),
        br#"{"message":"KME is busy"}"#.into(),
    ]
}

/// `CN=kme-a`, in DER.
pub fn subject_seeds() -> Vec<Vec<u8>> {
    vec![b"\x31\x0e\x30\x0c\x06\x03\x55\x04\x03\x0c\x05kme-a".to_vec()]
}
