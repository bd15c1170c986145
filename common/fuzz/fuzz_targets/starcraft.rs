//! What a game of StarCraft II answers.
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    rit_fuzz_checks::starcraft::check(input);
});
