//! JSON that is allowed but rare, and JSON that is not.

use etsi_qkd014::{Error, KeyContainer, Quirks, Status};

use crate::kme::{ID, KEY, Kme, container};

async fn enc(body: &str, quirks: Quirks) -> Result<KeyContainer, Error> {
    let kme = Kme::answering(body.as_bytes()).await;
    kme.client().quirks(quirks).build().unwrap().enc_keys("sae-b").send().await
}

async fn status(body: &str) -> Result<Status, Error> {
    Kme::answering(body.as_bytes()).await.client().build().unwrap().status("sae-b").await
}

async fn refused(body: &str) -> Error {
    let error = enc(body, Quirks::STRICT).await.err().unwrap_or_else(|| panic!("taken: {body}"));
    assert!(error.keys_may_be_consumed(), "{error}");
    assert!(!format!("{error} {error:?}").contains(&KEY[..12]), "{error:?}");
    error
}

#[tokio::test]
async fn a_member_that_comes_twice_is_refused_however_it_is_spelled() {
    let key = format!(r#""key":"{KEY}""#);
    let twice = [
        format!(r#"{{"keys":[{{"key_ID":"{ID}","key_ID":"{ID}",{key}}}]}}"#),
        format!(r#"{{"keys":[{{"key_ID":"{ID}","key\u005fID":"{ID}",{key}}}]}}"#),
        format!(r#"{{"keys":[{{"key_ID":"{ID}",{key},{key}}}]}}"#),
        format!(r#"{{"keys":[{{"key_ID":"{ID}",{key},"\u006bey":null}}]}}"#),
        format!(r#"{{"keys":[{{"key_ID":"{ID}",{key}}}],"keys":[]}}"#),
    ];
    for body in &twice {
        let error = refused(body).await;
        assert!(error.to_string().contains("twice"), "{error}");
    }
    let cased = format!(r#"{{"Keys":[],"keys":[{{"key_ID":"{ID}",{key}}}]}}"#);
    for quirks in [Quirks::STRICT, Quirks::ANY_CASE_MEMBERS | Quirks::EXTRA_MEMBERS] {
        assert!(enc(&cased, quirks).await.is_err(), "{quirks:?}");
    }
}

#[tokio::test]
async fn escapes_in_a_key_id_are_decoded_before_validation() {
    let with = |id: &str| container().replace(ID, id);
    let escaped: String = ID.chars().map(|c| format!("\\u{:04x}", u32::from(c))).collect();
    let key = enc(&with(&escaped), Quirks::STRICT).await.unwrap().into_single();
    assert_eq!(key.key_id(), ID);
    let cut = &ID[..ID.len() - 1];
    for last in
        ["\\u0000", "\\n", "\\ud800", "\\ud800x", "\\u00e9", "\u{ff19}", "\\x39", "\\u39", "\""]
    {
        let body = with(&format!("{cut}{last}"));
        refused(&body).await;
        // The quirk for other forms of key_IDs does not accept these either.
        assert!(enc(&body, Quirks::ANY_KEY_ID).await.is_err(), "{body}");
    }
}

#[tokio::test]
async fn base64_is_rfc_4648_section_4_with_optional_white_space() {
    let with = |key: &str| container().replace(KEY, key);
    let spaced = KEY.replace("x4Ly", "x4\\r\\nLy").replace('/', "\\/").replace('+', "\\u002b");
    let key = enc(&with(&format!(" {spaced}\\t")), Quirks::STRICT).await.unwrap().into_single();
    let plain = enc(&container(), Quirks::STRICT).await.unwrap().into_single();
    assert!(key == plain);
    for bad in [
        KEY.replace('/', "_").replace('+', "-"),
        KEY.trim_end_matches('=').to_owned(),
        format!("{KEY}="),
        format!("{KEY}{KEY}"),
        KEY.replace("s=", "t="),
        KEY.replace('w', "\u{ff57}"),
        format!("{KEY}\\u0000"),
        format!("data:;base64,{KEY}"),
        KEY.replacen('w', "=", 1),
        String::new(),
        "====".to_owned(),
    ] {
        let error = refused(&with(&bad)).await;
        assert!(matches!(error.cause(), Error::Malformed { .. }), "{bad}: {error}");
    }
}

#[tokio::test]
async fn numbers_of_a_status_are_whole_and_in_bounds() {
    let with = |count: &str| {
        format!(
            r#"{{"source_KME_ID":"a","target_KME_ID":"b","master_SAE_ID":"sae-a","slave_SAE_ID":"sae-b",
            "key_size":256,"stored_key_count":{count},"max_key_count":1,"max_key_per_request":1,
            "max_key_size":256,"min_key_size":256,"max_SAE_ID_count":0}}"#
        )
    };
    let huge = "9".repeat(100_000);
    let bad =
        ["1e999", "1e3", "1.0", "-0", "-1", "18446744073709551616", "+1", "01", "0x10", "NaN"];
    for count in bad.into_iter().chain(["\"256\"", "true", "[1]", "null", &huge]) {
        let error = status(&with(count)).await;
        let error = error.err().unwrap_or_else(|| panic!("{count} was taken"));
        assert!(matches!(error, Error::Malformed { .. }), "{error}");
        assert!(error.to_string().len() < 200, "the number is not repeated");
    }
    let largest = status(&with("18446744073709551615")).await.unwrap();
    assert_eq!(largest.stored_key_count, u64::MAX);
}

#[tokio::test]
async fn numbers_and_depth_of_an_extension_are_bounded() {
    let with = |extension: &str| {
        format!(
            "{},\"key_container_extension\":{extension}}}",
            &container()[..container().len() - 1]
        )
    };
    let nested = |levels: usize| format!("{{\"a\":{}{}}}", "[".repeat(levels), "]".repeat(levels));
    for bad in ["{\"a\":1e999}", &nested(32), &nested(100_000), "{\"a\":\"\\ud800\"}", "null"] {
        let error = refused(&with(bad)).await;
        assert!(matches!(error.cause(), Error::Malformed { .. }), "{error}");
    }
    let deepest = enc(&with(&nested(31)), Quirks::STRICT).await.unwrap();
    assert!(deepest.extension.unwrap()["a"].is_array());
    // Ignored, and so never gone into.
    let ignored = with(&nested(100_000)).replace("key_container_extension", "other");
    enc(&ignored, Quirks::EXTRA_MEMBERS).await.unwrap();
}

#[tokio::test]
async fn keys_in_place_of_names_and_ids_are_not_told() {
    for body in [
        format!(r#"{{"{KEY}":[]}}"#),
        format!(r#"{{"keys":[{{"{KEY}":1,"key_ID":"{ID}","key":"{KEY}"}}]}}"#),
        format!(r#"{{"keys":[{{"key_ID":"{KEY}","key":"{ID}"}}]}}"#),
        format!(r#"{{"keys":["{KEY}"]}}"#),
        format!(r#"{{"keys":{{"{ID}":"{KEY}"}}}}"#),
        format!(r#"["{KEY}"]"#),
        format!(r#"{} "{KEY}""#, container()),
    ] {
        refused(&body).await;
    }
}
