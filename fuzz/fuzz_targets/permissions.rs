#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    axon_fuzz::sros2::permissions(data);
});
