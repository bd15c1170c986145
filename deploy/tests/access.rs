//! Only callers that may get in: what a learner demands over TCP, and what becomes of those who cannot show it.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, Train, output};
use std::{fs, os::unix::fs::PermissionsExt as _, process::Output};

const TCP: &[&str] =
    &["matrix-game", "--seed", "3", "--actors", "1", "--set", "learner.listen=tcp:127.0.0.1:0"];

/// A run that listens on loopback, and where.
fn listening(folder: &RunFolder, settings: &[String]) -> (Train, String) {
    let mut arguments = TCP.to_vec();
    arguments.extend(settings.iter().flat_map(|setting| ["--set", setting]));
    let mut train = folder.start(&arguments);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    (train, folder.remote_address())
}

/// Checks that a command ended with exit code 2 and one line that says all of this.
#[track_caller]
fn refused(output: &Output, message: &[&str]) {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert_eq!(stderr.lines().filter(|line| line.starts_with("error: ")).count(), 1, "{stderr}");
    for part in message {
        assert!(stderr.contains(part), "{part:?} in {stderr}");
    }
}

#[test]
fn a_port_without_token_or_certificate_is_not_opened() {
    let folder = RunFolder::new();
    let run_dir = folder.run_dir();
    let train = |settings: &[&str], message: &[&str]| {
        let mut arguments = vec!["train", "matrix-game", "--run-dir", run_dir.to_str().unwrap()];
        arguments.extend(settings.iter().flat_map(|setting| ["--set", setting]));
        refused(&output(&arguments), message);
        assert!(!run_dir.exists(), "the same directory will do for the next attempt");
    };
    let token = folder.secret("token");
    let token_file = format!("learner.token_file={}", token.display());
    train(&["learner.listen=tcp:127.0.0.1:0"], &["anybody could call", "learner.tls.client_ca"]);
    train(&["learner.listen=tcp:0.0.0.0:0", &token_file], &["in clear text", "learner.tls.certificate"]);
    train(&["learner.listen=tcp:learner:1", &token_file], &["in clear text"]);
    train(&["learner.listen=tcp:localhost:1", &token_file], &["a learner listens on an IP address"]);
    train(&["learner.listen=127.0.0.1:1"], &["is no address; write unix:PATH or tcp:HOST:PORT"]);
    fs::set_permissions(&token, fs::Permissions::from_mode(0o644)).unwrap();
    train(&["learner.listen=tcp:127.0.0.1:0", &token_file], &["can be read by others", "chmod 600 "]);
}

#[test]
fn a_token_opens_a_loopback_port_and_nothing_else_does() {
    let folder = RunFolder::new();
    let (token, wrong) = (folder.secret("token"), folder.secret("wrong"));
    let (_train, address) = listening(&folder, &[format!("learner.token_file={}", token.display())]);
    let status = |token: &[&str]| output(&[&["ctl", "--address", &address], token, &["status"]].concat());
    let with = |token: &std::path::Path| status(&["--token-file", token.to_str().unwrap()]);
    let answer = with(&token);
    assert!(answer.status.success(), "{}", String::from_utf8_lossy(&answer.stderr));
    assert!(String::from_utf8_lossy(&answer.stdout).contains("environment steps"));
    refused(&with(&wrong), &["refuses this caller's token", "--token-file"]);
    refused(&status(&[]), &["refuses this caller's token"]);
    // The token of the socket in the run directory is another one.
    refused(&with(&folder.run_dir().join("token")), &["refuses this caller's token"]);
    let actor = output(&["actor", "--address", &address, "--token-file", wrong.to_str().unwrap()]);
    refused(&actor, &["refuses this caller's token"]);
    // Far more than any request has.
    let tasks = format!("{},", "x".repeat(1000)).repeat(100);
    let large = ["ctl", "--address", &address, "--token-file", token.to_str().unwrap()];
    let large = output(&[&large[..], &["evaluate", "--tasks", tasks.trim_end_matches(',')]].concat());
    assert_eq!(large.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&large.stderr).contains("message length too large"), "{large:?}");
    assert!(with(&token).status.success(), "and all goes on");
    fs::set_permissions(&token, fs::Permissions::from_mode(0o640)).unwrap();
    refused(&with(&token), &["can be read by others (mode 640)", "chmod 600 "]);
}

#[test]
fn certificates_are_made_and_demanded() {
    let folder = RunFolder::new();
    let make = |name: &str| {
        let out = folder.path().join(name);
        let made =
            output(&["certificates", "--out", out.to_str().unwrap(), "--host", "127.0.0.1", "localhost"]);
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        out
    };
    let (ours, theirs) = (make("ours"), make("theirs"));
    for key in ["ca.key", "learner.key", "client.key"] {
        assert_eq!(fs::metadata(ours.join(key)).unwrap().permissions().mode() & 0o777, 0o600, "{key}");
    }
    let again = output(&["certificates", "--out", ours.to_str().unwrap(), "--host", "127.0.0.1"]);
    refused(&again, &["ca.pem", "nothing is written over"]);

    let setting = |key: &str, file: &str| format!("learner.tls.{key}={}", ours.join(file).display());
    let settings = [
        setting("certificate", "learner.pem"),
        setting("key", "learner.key"),
        setting("client_ca", "ca.pem"),
    ];
    let (_train, address) = listening(&folder, &settings);
    let port = address.rsplit_once(':').unwrap().1;
    let status = |address: &str, ca: &std::path::Path, client: Option<&std::path::Path>| {
        let file = |folder: &std::path::Path, name: &str| folder.join(name).display().to_string();
        let mut arguments = vec!["ctl".to_owned(), "--address".into(), address.into()];
        arguments.extend(["--tls-ca".into(), file(ca, "ca.pem")]);
        if let Some(client) = client {
            arguments.extend(["--tls-certificate".into(), file(client, "client.pem")]);
            arguments.extend(["--tls-key".into(), file(client, "client.key")]);
        }
        arguments.push("status".into());
        output(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
    };
    for address in [&address, &format!("tcp:localhost:{port}")] {
        let answer = status(address, &ours, Some(&ours));
        assert!(answer.status.success(), "{address}: {}", String::from_utf8_lossy(&answer.stderr));
    }
    refused(&status(&address, &ours, None), &["CertificateRequired", "--tls-certificate"]);
    refused(&status(&address, &ours, Some(&theirs)), &["refuses this caller's certificate"]);
    refused(&status(&address, &theirs, Some(&theirs)), &["does not prove to be the learner", "--tls-ca"]);
}
