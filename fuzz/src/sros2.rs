//! Permissions of an SROS2 enclave, signed or not.

use std::time::{Duration, UNIX_EPOCH};

use axon_transport::{graph::EndpointKind, sros2::EnclavePermissions};

/// The enclave that each seed is about.
const ENCLAVE: &str = "/arm";

/// Checks the parser of a permissions file. The same input has the same outcome. An error is one line. An accepted file
/// names the enclave, and judges each kind of endpoint without a panic. A denial names a line of the file. Where
/// nothing may be done in a domain, nothing is allowed there.
pub fn permissions(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else { return false };
    let read = || EnclavePermissions::parse(text, "permissions.p7s", ENCLAVE);
    let outcome = read();
    assert_eq!(format!("{outcome:?}"), format!("{:?}", read()), "two outcomes of one input");
    let permissions = match outcome {
        Ok(permissions) => permissions,
        Err(error) => {
            let error = error.to_string();
            assert!(!error.chars().any(char::is_control), "not one line: {error:?}");
            return false;
        }
    };
    assert!(text.contains("CN=") && permissions.enclave() == ENCLAVE);
    let lines = u32::try_from(text.matches('\n').count() + 1).unwrap();
    for domain in [0, 7, 232] {
        for seconds in [0, 1_780_272_000, 4_102_444_800] {
            let now = UNIX_EPOCH + Duration::from_secs(seconds);
            let joins = permissions.check_domain(domain, now).is_ok();
            for kind in [
                EndpointKind::Publisher,
                EndpointKind::Subscription,
                EndpointKind::Client,
                EndpointKind::Server,
            ] {
                for name in ["/a", "/arm/joints", "Square"] {
                    match permissions.check(kind, name, domain, now) {
                        Ok(()) => assert!(joins, "allowed where nothing is"),
                        Err(denial) => {
                            assert!((1..=lines).contains(&denial.line()), "{denial}");
                            assert!(!denial.to_string().contains('\n'), "{denial}");
                        }
                    }
                }
            }
        }
    }
    true
}

/// Returns files that `ros2 security` writes, signed and not, with each existing element.
pub fn seeds() -> Vec<Vec<u8>> {
    let made = "<dds xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
                xsi:noNamespaceSchemaLocation=\"http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd\">\n\
                <permissions>\n<grant name=\"/arm\">\n<subject_name>CN=/arm</subject_name>\n<validity>\n\
                <not_before>2026-01-01T00:00:00</not_before>\n<not_after>2036-01-01T00:00:00</not_after>\n</validity>\n\
                <allow_rule>\n<domains>\n<id>0</id>\n</domains>\n<publish>\n<topics>\n<topic>rt/*</topic>\n\
                <topic>rq/*Request</topic>\n<topic>rr/*Reply</topic>\n</topics>\n</publish>\n<subscribe>\n<topics>\n\
                <topic>rt/*</topic>\n</topics>\n</subscribe>\n</allow_rule>\n<default>DENY</default>\n</grant>\n\
                </permissions>\n</dds>\n";
    let every = "<dds><permissions><grant name='x'><subject_name>O=a,CN=/arm</subject_name><validity>\
                 <not_before>2026-01-01T00:00:00Z</not_before><not_after>2036-01-01T00:00:00.5+02:00</not_after></validity>\
                 <deny_rule><domains><id>0</id><id_range><min>7</min><max>9</max></id_range><id_range><min>200</min>\
                 </id_range></domains><publish><topics><topic>rt/[a-c[:digit:]]?\\**</topic></topics><partitions>\
                 <partition/><partition>a*</partition></partitions></publish><relay><topics><topic>*</topic></topics>\
                 </relay></deny_rule><allow_rule><domains><id>0</id></domains></allow_rule><default>ALLOW</default>\
                 </grant></permissions></dds>";
    let signed = format!(
        "MIME-Version: 1.0\nContent-Type: multipart/signed; protocol=\"application/x-pkcs7-signature\"; \
         micalg=\"sha-256\"; boundary=\"----AB\"\n\nThis is an S/MIME signed message\n\n------AB\n\
         Content-Type: text/plain\r\n\r\n{}\n------AB\nContent-Type: application/x-pkcs7-signature; name=\"smime.p7s\"\n\
         Content-Transfer-Encoding: base64\nContent-Disposition: attachment; filename=\"smime.p7s\"\n\nMII=\n\n------AB--\n\n",
        made.replace('\n', "\r\n")
    );
    [made.to_owned(), every.to_owned(), signed].map(String::into_bytes).into()
}
