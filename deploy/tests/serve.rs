//! `rit serve`: who gets in, and what is there to see, over real sockets.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, refused, rit};
use rustix::process::{Pid, Signal, kill_process};
use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    process::{Child, Stdio},
    time::{Duration, Instant},
};

/// What a run needs to be over at once.
const TINY: [&str; 6] = ["--steps", "40", "--actors", "1", "--set", "evaluation.episodes=1"];

/// A server, ended when dropped.
struct Server {
    child: Child,
    address: String,
    token: String,
}

impl Server {
    fn start(folder: &str) -> Self {
        let mut child = rit(&["serve", folder]).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let (address, token) =
            line.trim().strip_prefix("web page: http://").unwrap().split_once("/?token=").unwrap();
        Self { address: address.to_owned(), token: token.to_owned(), child }
    }

    /// Status, headers and body of an answer.
    fn get(&self, path: &str, headers: &str) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        let host =
            if headers.contains("Host:") { String::new() } else { format!("Host: {}\r\n", self.address) };
        write!(stream, "GET {path} HTTP/1.1\r\n{host}Connection: close\r\n{headers}\r\n").unwrap();
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).unwrap();
        let end = bytes.windows(4).position(|window| window == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head, bytes[end + 4..].to_vec())
    }

    fn page(&self, path: &str) -> String {
        let (status, _, body) = self.get(path, &format!("Authorization: Bearer {}\r\n", self.token));
        assert_eq!(status, 200, "{path}");
        String::from_utf8(body).unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = kill_process(Pid::from_child(&self.child), Signal::INT);
        assert!(self.child.wait().unwrap().success());
    }
}

#[test]
fn a_folder_of_runs_is_shown_to_callers_that_know_the_token() {
    let folder = RunFolder::new();
    folder.train(&["cooperative-navigation", "--steps", "200", "--set", "evaluation.episodes=2"]);
    let server = Server::start(folder.path().to_str().unwrap());
    assert_eq!(server.get("/runs", "").0, 401);
    assert_eq!(server.get("/runs", "Authorization: Bearer wrong\r\n").0, 401);
    let evil = format!("Host: evil.example\r\nAuthorization: Bearer {}\r\n", server.token);
    assert_eq!(server.get("/runs", &evil).0, 403);
    let (status, head, _) = server.get(&format!("/?token={}", server.token), "");
    let cookie = head.lines().find_map(|line| line.strip_prefix("set-cookie: ")).unwrap();
    assert!(status == 303 && head.contains("content-security-policy: default-src 'self'"), "{head}");
    let cookie = format!("Cookie: {}\r\n", cookie.split(';').next().unwrap());
    let (status, head, _) = server.get("/", &cookie);
    assert!(status == 303 && head.contains("location: /runs"), "{head}");
    assert_eq!(server.get("/runs", &cookie).0, 200);

    let all = server.page("/runs");
    for word in ["Cooperative navigation", "<svg", "finished", "href=\"/runs/run\""] {
        assert!(all.contains(word), "{word:?} is not in {all}");
    }
    assert!(!all.contains("<script") && !all.contains("<style"), "the policy would not let them in");
    let one = server.page("/runs/run");
    assert!(one.contains("href=\"/runs/run/navigation-4-4/0\"") && one.contains("navigation-2-2"), "{one}");
    let episode = server.page("/runs/run/navigation-4-4/7");
    assert!(episode.contains("src=\"/runs/run/navigation-4-4/7/episode.gif\""), "{episode}");
    let bearer = format!("Authorization: Bearer {}\r\n", server.token);
    let (status, head, gif) = server.get("/runs/run/navigation-4-4/7/episode.gif", &bearer);
    assert!(
        status == 200 && head.contains("content-type: image/gif") && gif.starts_with(b"GIF89a"),
        "{head}"
    );
    let last = format!("/runs/run/navigation-4-4/{}", u64::MAX);
    let nothing = [
        "/runs/0",
        "/runs/..%2Frun",
        "/runs/run/navigation-9-9/0",
        "/runs/run/..%2f..%2fetc/0",
        "/elsewhere",
    ];
    for nothing in nothing.into_iter().chain([&*last, &*format!("{last}/episode.gif")]) {
        assert_eq!(server.get(nothing, &bearer).0, 404, "{nothing}");
    }

    // A run that comes before it in the list takes no other's address.
    let other = folder.path().join("another one");
    let trained =
        rit(&["train", "matrix-game", "--json", "--run-dir", other.to_str().unwrap()]).args(TINY).output();
    assert!(trained.unwrap().status.success());
    let all = server.page("/runs");
    assert!(all.contains("href=\"/runs/another%20one\"") && all.contains("href=\"/runs/run\""), "{all}");
    for (page, task) in [("/runs/run", "navigation-2-2"), ("/runs/another%20one", "game-1")] {
        assert!(server.page(page).contains(task), "{page}");
    }
}

/// Browsers hold connections that they may use again.
#[test]
fn an_idle_connection_does_not_keep_it_from_ending() {
    let folder = RunFolder::new();
    folder.train(&[&["matrix-game"], &TINY[..]].concat());
    let server = Server::start(folder.path().to_str().unwrap());
    let mut idle = TcpStream::connect(&server.address).unwrap();
    let (host, token) = (&server.address, &server.token);
    write!(idle, "GET /page.css HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n").unwrap();
    let mut answer = [0; 12];
    idle.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 200");
    let begun = Instant::now();
    drop(server);
    // The connection might lie idle for ten seconds.
    assert!(begun.elapsed() < Duration::from_secs(6), "{:?}", begun.elapsed());
}

#[test]
fn what_cannot_be_served_is_refused() {
    let empty = tempfile::tempdir().unwrap();
    let empty = empty.path().to_str().unwrap();
    refused(&["serve", empty], &["holds no record of a run"]);
    refused(&["serve", empty, "--listen", "0.0.0.0:8080"], &["this machine only"]);
    refused(&["serve", empty, "--listen", "off"], &["--listen off"]);
}
