//! What a process that holds environments says.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    rit_fuzz_checks::worker::check(input);
});
