//! What a person types.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    rit_fuzz_checks::config::check(input);
});
