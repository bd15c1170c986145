//! Frames as they lie in shared memory.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    rit_fuzz_checks::frame::check(input);
});
