//! The web page of a real run: who gets in, what is answered, and the page itself in a real browser.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

#[path = "web/browser.rs"]
mod browser;
mod common;

use browser::{Browser, OUT_OF_PLACE};
use common::{RunFolder, Train, kill, learner_pid, output};
use rustix::process::Signal;
use serde_json::{Value, json};
use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::{TcpListener, TcpStream},
    os::unix::fs::PermissionsExt as _,
    time::Duration,
};

/// Far beyond what a step takes.
const DEADLINE: Duration = Duration::from_secs(120);

/// What a server answered.
struct Answer {
    status: u16,
    /// In small letters.
    head: String,
    body: String,
}

impl Answer {
    fn json(&self) -> Value {
        assert_eq!(self.status, 200, "{}", self.body);
        serde_json::from_str(&self.body).unwrap()
    }
}

/// A run's web server, spoken to byte by byte.
struct Server {
    /// Address and port.
    host: String,
    token: String,
}

impl Server {
    fn of(folder: &RunFolder) -> Self {
        let url = std::fs::read_to_string(folder.run_dir().join("web")).unwrap();
        let (host, token) = url.trim().strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
        Self { host: host.to_owned(), token: token.to_owned() }
    }

    fn origin(&self) -> String {
        format!("http://{}", self.host)
    }

    /// Sends a request with these headers, and `Host` unless it is among them.
    fn open(&self, request: &str, headers: &[(&str, &str)], body: &str) -> TcpStream {
        let mut stream = TcpStream::connect(&self.host).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        let mut text =
            format!("{request} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
        if headers.iter().all(|(name, _)| *name != "Host") {
            text += &format!("Host: {}\r\n", self.host);
        }
        for (name, value) in headers {
            text += &format!("{name}: {value}\r\n");
        }
        stream.write_all((text + "\r\n" + body).as_bytes()).unwrap();
        stream
    }

    fn send(&self, request: &str, headers: &[(&str, &str)], body: &str) -> Answer {
        let mut text = String::new();
        self.open(request, headers, body).read_to_string(&mut text).unwrap();
        let (head, body) = text.split_once("\r\n\r\n").unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Answer { status, head: head.to_lowercase(), body: body.to_owned() }
    }

    /// As a caller who knows the token.
    fn get(&self, path: &str) -> Answer {
        self.send(&format!("GET {path}"), &[("Authorization", &format!("Bearer {}", self.token))], "")
    }

    /// As the page itself.
    fn post(&self, path: &str, body: &Value) -> Answer {
        let (bearer, body) = (format!("Bearer {}", self.token), body.to_string());
        let headers =
            [("Authorization", &*bearer), ("Origin", &self.origin()), ("Content-Type", "application/json")];
        self.send(&format!("POST {path}"), &headers, &body)
    }

    /// The names and ids of events up to the first of this name, and its data.
    fn events_until(&self, wanted: &str, since: &str) -> (Vec<String>, String, Value) {
        let bearer = format!("Bearer {}", self.token);
        let headers = [("Authorization", &*bearer), ("Last-Event-ID", since)];
        let lines = BufReader::new(self.open("GET /api/events", &headers, "")).lines();
        let (mut names, mut id) = (Vec::new(), String::new());
        for line in lines.map(Result::unwrap) {
            match line.split_once(": ") {
                Some(("event", name)) => names.push(name.to_owned()),
                Some(("id", found)) => found.clone_into(&mut id),
                Some(("data", data)) if names.last().is_some_and(|name| name == wanted) => {
                    // Events give their id after their data.
                    return (names, id, serde_json::from_str(data).unwrap());
                }
                _ => {}
            }
        }
        panic!("no event {wanted} after {names:?}");
    }
}

fn started(folder: &RunFolder, arguments: &[&str]) -> Train {
    let mut train = folder.start(&[&["matrix-game", "--actors", "1", "--seed", "1"], arguments].concat());
    train.wait_for("training", |status| status["updates"].as_u64() > Some(10));
    train
}

fn state(train: &Train) -> Value {
    serde_json::from_slice::<Value>(&train.ctl(&["status"]).stdout).unwrap()["state"].clone()
}

#[test]
fn only_who_knows_the_token_reads_and_only_the_page_itself_changes() {
    let folder = RunFolder::new();
    let train = started(&folder, &[]);
    let server = Server::of(&folder);
    let file = std::fs::metadata(folder.run_dir().join("web")).unwrap();
    assert_eq!(file.permissions().mode() & 0o777, 0o600);
    let url: Value = serde_json::from_slice(&train.ctl(&["web"]).stdout).unwrap();
    assert_eq!(url["url"], format!("{}/?token={}", server.origin(), server.token));

    // Without the token, or with another.
    assert_eq!(server.send("GET /healthz", &[], "").body, "ok\n");
    let wrong = server.token.replace(|digit: char| digit.is_ascii_digit(), "e");
    for path in ["/", "/main.js", "/api/run", "/api/events", "/nowhere", &format!("/?token={wrong}")] {
        let answer = server.send(&format!("GET {path}"), &[], "");
        assert_eq!(answer.status, 401, "{path}");
        assert!(!answer.body.contains("matrix-game"));
    }
    assert_eq!(server.send("POST /api/stop", &[("Origin", &server.origin())], "").status, 401);

    // With it: as a bearer, or by the cookie, which does not tell the token.
    let entered = server.send(&format!("GET /?token={}", server.token), &[], "");
    assert_eq!(entered.status, 303);
    assert!(entered.head.contains("location: /\r\n"), "{}", entered.head);
    let cookie = entered.head.lines().find_map(|line| line.strip_prefix("set-cookie: ")).unwrap();
    assert!(cookie.ends_with("; path=/; httponly; samesite=strict") && !cookie.contains(&server.token));
    let cookie = cookie.split(';').next().unwrap();
    let page = server.send("GET /", &[("Cookie", &format!("other=1; {cookie}"))], "");
    assert!(page.status == 200 && page.body.contains("Learning curves"));
    for header in [
        "content-security-policy: default-src 'self';",
        "x-frame-options: deny",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
        "cache-control: no-store",
    ] {
        assert!(page.head.contains(header), "{header}");
    }
    assert_eq!(server.send("GET /", &[("Cookie", &cookie.replace('a', "b"))], "").status, 401);
    assert_eq!(server.get("/api/run").json()["task_set"], "matrix-game");
    assert_eq!(server.get("/nowhere").status, 404);

    // Under another name that was made point here.
    let bearer = format!("Bearer {}", server.token);
    for (host, status) in
        [("rebound.example", 403), ("127.0.0.1.rebound.example", 403), ("localhost:1", 200), ("[::1]", 200)]
    {
        let headers = [("Authorization", &*bearer), ("Host", host)];
        assert_eq!(server.send("GET /api/run", &headers, "").status, status, "{host}");
    }

    // Another page of the same browser may not change anything, nor may a link.
    let port = server.host.split(':').nth(1).unwrap();
    let elsewhere =
        ["http://evil.example", "null", "http://127.0.0.1:1", &format!("https://127.0.0.1:{port}")];
    for origin in elsewhere {
        let headers = [("Cookie", cookie), ("Origin", origin)];
        assert_eq!(server.send("POST /api/pause", &headers, "").status, 403, "{origin}");
    }
    assert_eq!(server.send("POST /api/pause", &[("Cookie", cookie)], "").status, 403, "no origin");
    assert_eq!(server.get("/api/pause").status, 405);
    assert_eq!(state(&train), "running");
    let own = [("Cookie", cookie), ("Origin", &*server.origin())];
    assert_eq!(server.send("POST /api/pause", &own, "").json()["state"], "paused");
    assert_eq!(state(&train), "paused");
}

#[test]
fn what_is_asked_is_answered_and_nonsense_is_refused() {
    let folder = RunFolder::new();
    let mut train = started(&folder, &[]);
    let server = Server::of(&folder);
    assert_eq!(server.post("/api/pause", &Value::Null).json()["state"], "paused");
    train.wait_for("quiet", |status| {
        status["ledger"]["outstanding"] == 0 && status["ledger"]["inserted"] == status["episodes"]
    });

    let evaluation = server.post("/api/evaluate", &json!({ "tasks": ["game-2"], "episodes": 3 })).json();
    assert_eq!(
        (&evaluation["tasks"][0]["task"], &evaluation["tasks"][0]["episodes"]),
        (&json!("game-2"), &json!(3))
    );
    let shown = server.post("/api/watch", &json!({ "task": "game-2", "number": 1 })).json();
    assert_eq!(shown["weights_version"], evaluation["weights_version"]);
    assert_eq!(
        (shown["actions"].as_array().unwrap().len(), shown["scenes"].as_array().unwrap().len()),
        (2, 0)
    );
    let written = server.post("/api/checkpoint", &Value::Null).json();
    assert!(folder.run_dir().join(written["path"].as_str().unwrap()).is_dir());
    assert!(server.get("/metrics").body.ends_with("# EOF\n"));
    assert_eq!(server.send("GET /metrics", &[], "").status, 401);
    let log = server.get("/api/log?process=learner").json();
    assert_eq!(log["processes"], json!(["learner", "train", "actor-0"]));
    assert!(log["text"].as_str().unwrap().contains("the web page is served"));

    for (path, body, status, message) in [
        ("/api/evaluate", json!({ "tasks": ["chess"] }), 400, "unknown task \"chess\"; known: game-1"),
        ("/api/evaluate", json!({ "tasks": ["testing"] }), 400, "matrix-game has no testing tasks"),
        ("/api/evaluate", json!({ "tasks": [], "episodes": 1_000_001 }), 400, "at most 1000000"),
        ("/api/evaluate", json!({ "task": "game-1" }), 422, "unknown field"),
        ("/api/watch", json!({ "task": "x".repeat(5000), "number": 0 }), 413, "limit"),
        ("/api/watch", json!({ "task": "game-1", "number": -1 }), 422, "number"),
    ] {
        let answer = server.post(path, &body);
        assert_eq!(answer.status, status, "{body}");
        assert!(answer.body.contains(&message.replace('"', "\\\"")), "{}", answer.body);
    }
    let bearer = format!("Bearer {}", server.token);
    let plain = [("Authorization", &*bearer), ("Origin", &*server.origin()), ("Content-Type", "text/plain")];
    assert_eq!(server.send("POST /api/evaluate", &plain, r#"{"tasks":[]}"#).status, 415);
    for process in ["..%2Ftoken", "%2Fetc%2Fpasswd", "nobody"] {
        assert_eq!(server.get(&format!("/api/log?process={process}")).status, 404);
    }

    assert_eq!(server.post("/api/resume", &Value::Null).json()["state"], "running");
    assert_eq!(server.post("/api/stop", &Value::Null).json()["state"], "stopping");
    assert!(train.finish_stopped()["env_steps"].as_u64() < Some(50_000));
}

#[test]
fn a_page_goes_on_where_it_left_off_until_another_learner_serves_it() {
    let folder = RunFolder::new();
    let mut train = started(&folder, &["--set", "learner.metrics_every_env_steps=10"]);
    let server = Server::of(&folder);
    let (names, _, lines) = server.events_until("metrics", "");
    assert_eq!(names, ["reset", "status", "metrics"]);
    assert_eq!(lines[0]["kind"], "evaluation", "the first weights were evaluated");
    assert_eq!(server.post("/api/pause", &Value::Null).json()["state"], "paused");
    train.wait_for("quiet", |status| {
        status["ledger"]["outstanding"] == 0 && status["ledger"]["inserted"] == status["episodes"]
    });

    // Some lines are known, named by the learner and the bytes read; it goes on after them.
    let (_, id, _) = server.events_until("status", "");
    assert_eq!(id, "");
    let metrics = std::fs::read_to_string(folder.run_dir().join("metrics.jsonl")).unwrap();
    let position = position_of(&server);
    let known: usize = metrics.split_inclusive('\n').take(2).map(str::len).sum();
    let since = format!("{}-{known}", position.split('-').next().unwrap());
    let (names, _, lines) = server.events_until("metrics", &since);
    assert_eq!(names, ["status", "metrics"]);
    let third: Value = serde_json::from_str(metrics.lines().nth(2).unwrap()).unwrap();
    assert_eq!(lines[0], third);

    // A restarted learner has the same address and knows the same token, but not what the page has read.
    let written = server.post("/api/checkpoint", &Value::Null).json();
    let before = learner_pid(&serde_json::from_slice(&train.ctl(&["status"]).stdout).unwrap());
    kill(before, Signal::KILL);
    train.wait_for("another learner", |status| learner_pid(status) != before);
    assert_eq!(Server::of(&folder).host, server.host);
    let (names, _, status) = server.events_until("status", &since);
    assert_eq!(names, ["reset", "status"]);
    assert!(status["env_steps"].as_u64() >= written["env_steps"].as_u64());
}

/// The id of the first metrics event.
fn position_of(server: &Server) -> String {
    let bearer = format!("Bearer {}", server.token);
    let lines = BufReader::new(server.open("GET /api/events", &[("Authorization", &*bearer)], "")).lines();
    lines.map(Result::unwrap).find_map(|line| line.strip_prefix("id: ").map(str::to_owned)).unwrap()
}

#[test]
fn looking_on_changes_no_weight() {
    let arguments = ["matrix-game", "--actors", "1", "--seed", "3", "--steps", "2000"];
    let alone = RunFolder::new().train(&[&arguments[..], &["--set", "web.listen=off"]].concat());
    let folder = RunFolder::new();
    let mut train = folder.start(&arguments);
    train.wait_for("training", |status| status["updates"].as_u64() > Some(0));
    let server = Server::of(&folder);
    server.events_until("status", "");
    for number in 0..5 {
        server.post("/api/pause", &Value::Null).json();
        server.post("/api/watch", &json!({ "task": "game-1", "number": number })).json();
        server.post("/api/resume", &Value::Null).json();
        server.post("/api/evaluate", &json!({ "tasks": ["training"], "episodes": 5 })).json();
    }
    assert_eq!(train.finish()["weights_digest"], alone["weights_digest"]);
}

#[test]
fn the_page_is_for_this_machine_alone_or_off() {
    let error = |listen: &str| {
        let folder = RunFolder::new();
        let run_dir = folder.run_dir();
        let set = format!("web.listen={listen}");
        let tried = output(&["train", "matrix-game", "--run-dir", run_dir.to_str().unwrap(), "--set", &set]);
        assert_eq!(tried.status.code(), Some(2));
        assert!(!run_dir.exists());
        String::from_utf8(tried.stderr).unwrap()
    };
    assert!(error("0.0.0.0:8080").contains("ssh -L 8080:127.0.0.1:8080"));
    let taken = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let held = TcpListener::bind(taken).unwrap();
    assert!(error(&taken.to_string()).contains("is in use; write another port"));
    drop(held);

    let folder = RunFolder::new();
    let train = started(&folder, &["--set", "web.listen=off"]);
    assert!(!folder.run_dir().join("web").exists());
    let asked = train.ctl(&["web"]);
    assert_eq!(asked.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&asked.stderr).contains("serves no web page"));
}

#[tokio::test]
async fn a_browser_shows_the_run_and_steers_it() {
    let folder = RunFolder::new();
    let Some(browser) = Browser::start(&folder).await else { return };
    let mut train = folder.start(&[
        "cooperative-navigation",
        "--actors",
        "2",
        "--set",
        "learner.metrics_every_env_steps=200",
        "--set",
        "algorithm.batch_size=8",
        "--set",
        "checkpoints.every_env_steps=400",
    ]);
    let status = train.wait_for("a checkpoint", |status| status["env_steps"].as_u64() > Some(800));
    let server = Server::of(&folder);
    browser.client.goto(&format!("{}/?token={}", server.origin(), server.token)).await.unwrap();
    assert_eq!(browser.client.current_url().await.unwrap().as_str(), format!("{}/", server.origin()));
    // A line a task, each with a point a metrics line at least.
    browser.wait_for("#curve path.series.c2").await;
    browser.wait_for_state("running").await;
    assert_eq!(browser.client.title().await.unwrap(), "running · run · RIT");
    browser.wait_for("#processes tr:nth-child(3)").await;
    let processes = browser.js("return document.getElementById('processes').innerText").await;
    assert!(processes.as_str().unwrap().contains("actor-1"), "{processes}");

    browser.click("pause").await;
    browser.wait_for_state("paused").await;
    assert_eq!(state(&train), "paused");
    browser.click("pause").await;
    browser.wait_for_state("running").await;
    assert_eq!(state(&train), "running");

    browser.click("evaluate").await;
    browser.js("document.getElementById('evaluate-episodes').value = 2").await;
    browser.click("evaluate-go").await;
    browser.wait_for("#evaluate-result tbody tr:nth-child(3)").await;
    browser.click("evaluate-close").await;

    browser.js("document.getElementById('episode-speed').value = 10").await;
    browser.click("episode-roll").await;
    browser.wait_for("#episode[data-episode='navigation-4-4 0']").await;
    assert_eq!(browser.js("return document.querySelectorAll('#episode-stage circle').length").await, 8);
    // Played to its end, it can be played again; and any step can be looked at.
    browser.wait_for("#episode[data-step='25']").await;
    let script = "const scrub = document.getElementById('episode-scrub'); scrub.value = 7;
        scrub.dispatchEvent(new Event('input')); return document.getElementById('episode-caption').textContent";
    assert!(browser.js(script).await.as_str().unwrap().starts_with("Step 7 of 25 · reward "));
    browser.click("episode-play").await;
    browser.wait_for("#episode[data-step='25']").await;

    // The page outlives the learner.
    kill(learner_pid(&status), Signal::KILL);
    browser.wait_for_state("no answer").await;
    browser.wait_for_state("running").await;
    // What both learners wrote is shown once.
    let script = "const line = document.querySelector('#curve path.series.c0').getAttribute('d');
        const xs = [...line.matchAll(/[ML]([0-9.]+)/g)].map((x) => Number(x[1]));
        return xs.length > 1 && xs.every((x, at) => at === 0 || xs[at - 1] < x)";
    assert_eq!(browser.js(script).await, true);

    // On a phone nothing is wider than the screen, leaves its card, or lies on other words.
    browser.client.set_window_size(390, 844).await.unwrap();
    browser.until(&format!("return innerWidth === 390 && ({OUT_OF_PLACE}).length === 0")).await;

    browser.click("stop").await;
    browser.click("stop-confirm").await;
    browser.wait_for_state("ended").await;
    let script = "return [...document.querySelectorAll('#processes .pill')].map((pill) => pill.textContent)";
    let states = browser.js(script).await;
    assert!(states.as_array().unwrap().iter().all(|state| state == "ended"), "{states}");
    train.finish_stopped();
}
