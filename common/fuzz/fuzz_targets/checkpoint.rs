//! A checkpoint and replay as they lie on disk.
#![no_main]

use rit_fuzz_checks::checkpoint::Run;
use std::cell::LazyCell;

thread_local! {
    static RUN: LazyCell<Run> = LazyCell::new(|| Run::new().expect("the temporary folder can be written"));
}

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    RUN.with(|run| run.check(input));
});
