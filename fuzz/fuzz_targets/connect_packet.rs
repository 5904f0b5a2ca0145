#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    axon_fuzz::transport::connect_packet(data);
});
