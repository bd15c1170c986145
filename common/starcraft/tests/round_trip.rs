//! Our messages against the published Python package: outside the default suite, since it needs that package.
//!
//! `pip install s2clientprotocol 'protobuf<4'` in a virtual environment, then
//! `RIT_PYTHON=VENV/bin/python cargo test -p rit-starcraft --test round_trip -- --ignored`.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, reason = "test code")]

use prost::Message;
use rit_starcraft::messages::{Request, Response};
use std::{
    env,
    io::Write as _,
    path::Path,
    process::{Command, Stdio},
};

fn bytes(digits: &str) -> Vec<u8> {
    (0..digits.len() / 2).map(|at| u8::from_str_radix(&digits[2 * at..2 * at + 2], 16).unwrap()).collect()
}

/// What their class wrote is read by ours without a loss, and written the same again.
fn check<M: Message + Default + std::fmt::Debug>(line: &str, theirs: &[u8]) {
    let ours = M::decode(theirs).unwrap_or_else(|error| panic!("{line}: {error}"));
    assert!(ours.encode_to_vec() == theirs, "{line} becomes {ours:?}");
}

#[test]
#[ignore = "needs Python with s2clientprotocol"]
fn our_messages_are_those_of_the_published_package() {
    let crate_dir = Path::new(env!("CARGO_MANIFEST_DIR"));
    let descriptors = protox::compile(["starcraft.proto"], [crate_dir.join("proto")]).unwrap();
    let python = env::var("RIT_PYTHON").unwrap_or_else(|_| "python3".into());
    let mut script = Command::new(python)
        .arg(crate_dir.join("tests/compare_messages.py"))
        .env("PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION", "python")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    script.stdin.take().unwrap().write_all(&descriptors.encode_to_vec()).unwrap();
    let output = script.wait_with_output().unwrap();
    assert!(output.status.success(), "the descriptors differ; see above");
    let lines = String::from_utf8(output.stdout).unwrap();
    let mut count = 0;
    for line in lines.lines() {
        let (name, digits) = line.split_once(' ').unwrap_or((line, ""));
        match name {
            "Request" => check::<Request>(line, &bytes(digits)),
            "Response" => check::<Response>(line, &bytes(digits)),
            other => panic!("{other:?}"),
        }
        count += 1;
    }
    assert_eq!(count, 800);
}
