//! What a game, a network or another program may do to a client: each time an error that says so, within the
//! deadline, and the next world works.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, reason = "test code")]

mod common;

use common::{at, endpoint, settings, task};
use prost::Message as _;
use rit_env::{
    EnvironmentError, EnvironmentFactory as _, FailureKind, Script, Split, TaskSet,
    combat::{CombatScript, CombatSet},
    rollout::{Job, Rollout},
};
use rit_episode::{Action, Choice, Observation, RunSeed, Stream};
use rit_starcraft::{
    Connection, ConnectionError, Settings, StarCraft, StarCraftError,
    endpoint::Options,
    messages::{
        Request, RequestPing, Response, ResponsePing, ResponseStep, Status, request::Request as Asked,
        response::Response as Body,
    },
};
use std::{
    io::{Read as _, Write as _},
    net::{Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};
use tungstenite::protocol::Message;

const SET: CombatSet = CombatSet::Marines;

/// Far beyond any deadline that a test sets.
const HANGS: Duration = Duration::from_secs(60);

/// A deadline that a test waits for.
const WAIT: Duration = Duration::from_millis(500);

/// A server that does this with every client.
fn server(serve: impl Fn(TcpStream) + Send + Sync + 'static) -> SocketAddr {
    let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let address = listener.local_addr().unwrap();
    let serve = Arc::new(serve);
    thread::spawn(move || {
        for stream in listener.incoming() {
            let serve = Arc::clone(&serve);
            thread::spawn(move || serve(stream.unwrap()));
        }
    });
    address
}

/// A server that answers each request with these messages, whatever it was.
fn answering(answers: impl Fn(&Request) -> Vec<Message> + Send + Sync + 'static) -> SocketAddr {
    server(move |stream| {
        let mut socket = tungstenite::accept(stream).unwrap();
        while let Ok(Message::Binary(bytes)) = socket.read() {
            for answer in answers(&Request::decode(bytes).unwrap()) {
                socket.send(answer).unwrap();
            }
        }
    })
}

fn message(response: &Response) -> Vec<Message> {
    vec![Message::Binary(response.encode_to_vec().into())]
}

/// A good answer to a ping.
fn pong(request: &Request) -> Response {
    Response {
        response: Some(Body::Ping(ResponsePing { base_build: Some(75_689), ..ResponsePing::default() })),
        id: request.id,
        error: vec![],
        status: Some(Status::Launched.into()),
    }
}

/// What a ping comes to, within the deadline.
fn ping(address: SocketAddr) -> Result<Body, ConnectionError> {
    Connection::open(address, WAIT)?.ask(Asked::Ping(RequestPing {}))
}

#[test]
fn what_is_no_answer_is_told_from_one() {
    assert!(ping(answering(|request| message(&pong(request)))).is_ok());
    type Answer = fn(&Request) -> Vec<Message>;
    let garbage: [(&str, Answer); 7] = [
        ("answer", |_| vec![Message::Binary(b"\xff\xff\xff\xff garbage".to_vec().into())]),
        ("text", |_| vec![Message::Text("SC2".into())]),
        ("number", |request| message(&Response { id: Some(request.id() + 1), ..pong(request) })),
        ("no status", |request| message(&Response { status: None, ..pong(request) })),
        ("answers step", |request| {
            let response = Some(Body::Step(ResponseStep::default()));
            message(&Response { response, ..pong(request) })
        }),
        ("it is empty", |request| message(&Response { response: None, ..pong(request) })),
        ("no status", |_| vec![Message::Binary(Vec::new().into())]),
    ];
    for (what, answer) in garbage {
        let error = ping(answering(answer)).unwrap_err();
        let words = error.to_string();
        assert!(matches!(error, ConnectionError::Garbage { .. }), "{what}: {words}");
        assert!(words.contains("ping") && words.contains(what) && !words.contains('\n'), "{what}: {words}");
    }
    let refused = ping(answering(|request| {
        let error = vec!["not\nnow".to_owned(), "\u{1b}[31mred".to_owned()];
        message(&Response { response: None, error, ..pong(request) })
    }));
    assert_eq!(refused.unwrap_err().to_string(), "the game refuses ping: not now;  [31mred");
    // A warning beside an answer is logged, no more.
    let warned =
        ping(answering(|request| message(&Response { error: vec!["mind".into()], ..pong(request) })));
    assert!(warned.is_ok());
    let closed = ping(answering(|_| vec![Message::Close(None)])).unwrap_err();
    assert!(matches!(closed, ConnectionError::Closed { request: "ping", .. }), "{closed}");
}

#[test]
fn what_is_no_game_is_told_from_one_that_starts_up() {
    let free = TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap();
    let not_found = server(|mut stream| {
        let _ = stream.read(&mut [0; 4096]);
        let _ = stream.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n");
    });
    let rude = server(drop);
    for (what, address) in [("refused", free), ("404", not_found), ("", rude)] {
        let error = Connection::open(address, HANGS).unwrap_err();
        let words = error.to_string();
        assert!(
            matches!(error, ConnectionError::NotReady { .. } | ConnectionError::Garbage { .. }),
            "{words}"
        );
        assert!(words.contains(what), "{words}");
    }
    let other = server(|mut stream| {
        let _ = stream.write_all(b"220 mail.example.org ESMTP\r\n\r\n");
    });
    let error = Connection::open(other, HANGS).unwrap_err();
    assert!(matches!(error, ConnectionError::Garbage { .. }), "{error}");
}

#[test]
fn one_that_is_slow_or_silent_has_until_the_deadline() {
    let begun = Instant::now();
    let silent = ping(answering(|_| vec![])).unwrap_err();
    assert_eq!(silent.to_string(), "no answer to ping within 0.5 s");
    // A frame of which a byte comes now and then is no answer either, however often something comes.
    let trickling = server(|stream| {
        let mut socket = tungstenite::accept(stream).unwrap();
        socket.read().unwrap();
        let stream = socket.get_mut();
        for byte in [0x82, 100].into_iter().chain([0; 90]) {
            if stream.write_all(&[byte]).is_err() {
                return;
            }
            thread::sleep(Duration::from_millis(50));
        }
    });
    let slow = ping(trickling).unwrap_err();
    assert!(matches!(slow, ConnectionError::TimedOut { request: "ping", .. }), "{slow}");
    // A silent handshake has a deadline of its own.
    let handshake = Connection::open(server(|stream| drop((thread::park(), stream))), WAIT).unwrap_err();
    assert!(matches!(handshake, ConnectionError::TimedOut { .. }), "{handshake}");
    assert!(begun.elapsed() < HANGS);
}

#[test]
fn a_frame_that_is_cut_off_is_a_lost_connection() {
    let cut = server(|stream| {
        let mut socket = tungstenite::accept(stream).unwrap();
        socket.read().unwrap();
        let _ = socket.get_mut().write_all(&[0x82, 100, 8, 1, 2]);
        let _ = socket.get_mut().shutdown(Shutdown::Both);
    });
    let error = ping(cut).unwrap_err();
    assert!(matches!(error, ConnectionError::Closed { request: "ping", .. }), "{error}");
}

#[test]
fn a_version_without_an_api_is_named() {
    let old = Options { base_build: 50_000, game_version: "3.0.0".into(), ..Options::default() };
    let error = StarCraft::at(endpoint(old), SET, settings()).game().unwrap_err();
    assert!(matches!(error, StarCraftError::Version { .. }), "{error}");
    assert!(error.to_string().contains("StarCraft II 3.0.0 (build 50000) is too old; 3.16.1"), "{error}");
}

/// Plays one battle of standing still.
fn play(worlds: &StarCraft, episode: u64) -> Result<usize, EnvironmentError> {
    let task = task(SET, "3m");
    let mut world = worlds.build(task)?;
    let rng = &mut RunSeed(1).stream(Stream::Environment, episode);
    world.begin_reset(rng)?;
    world.reset(rng)?;
    for step in 1.. {
        let spec = worlds.spec(task);
        let mut observation =
            Observation::new(spec.n_agents, spec.n_entities, spec.feature_dim, spec.n_actions);
        world.observe(&mut observation);
        let actions: Vec<Action> = (0..3).map(|agent| Action::from(observation.allows(agent, 1))).collect();
        world.begin_step(&actions)?;
        if world.step(&actions, rng)?.end.is_some() {
            return Ok(step);
        }
    }
    unreachable!()
}

/// Passes bytes on in both directions, until so many have come back; then the link is gone.
fn through(game: SocketAddr, bytes: usize) -> (SocketAddr, Arc<AtomicUsize>) {
    let links = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&links);
    let address = server(move |client| {
        // The first link breaks; later ones hold.
        let mut left = if counted.fetch_add(1, Ordering::Relaxed) == 0 { bytes } else { usize::MAX };
        let game = TcpStream::connect(game).unwrap();
        let (mut up_from, mut up_to) = (client.try_clone().unwrap(), game.try_clone().unwrap());
        thread::spawn(move || std::io::copy(&mut up_from, &mut up_to));
        let (mut from, mut to) = (game, client);
        let mut buffer = [0; 4096];
        while left > 0 {
            let most = left.min(buffer.len());
            let Ok(read @ 1..) = from.read(&mut buffer[..most]) else { break };
            if to.write_all(&buffer[..read]).is_err() {
                break;
            }
            left -= read;
        }
        for stream in [from, to] {
            let _ = stream.shutdown(Shutdown::Both);
        }
    });
    (address, links)
}

/// The connection breaks after so many bytes, in the handshake, in whatever answer: an error of what it is, and the
/// next battle is played.
#[test]
fn a_connection_that_breaks_in_any_phase_costs_one_battle() {
    let game = endpoint(Options::default());
    // The handshake is some 130 bytes, the way to the first observation some 2500, a step some 700.
    for bytes in (0..400).step_by(23).chain((400..8000).step_by(331)) {
        let (address, links) = through(game, bytes);
        let worlds = at(address, SET);
        let error = play(&worlds, 0).unwrap_err();
        assert!(!error.detail.contains('\n') && error.kind != FailureKind::TimedOut, "{bytes}: {error:?}");
        assert!(play(&worlds, 0).unwrap() > 5, "after {bytes} bytes: {}", error.detail);
        assert_eq!(links.load(Ordering::Relaxed), 2);
    }
}

/// A rollout whose games break now and then comes to all its episodes.
#[test]
fn episodes_that_are_lost_are_rolled_again() {
    let game = endpoint(Options::default());
    let (address, links) = through(game, 5_000);
    let tasks = TaskSet::Combat(SET).tasks(Split::Training);
    let job = |number| Job { number, weights_version: 0, choice: Choice::Greedy, task: Some(0) };
    let jobs: Vec<Job> = (0..6).map(job).collect();
    let mut rollout = Rollout::new(tasks, Arc::new(at(address, SET)), RunSeed(2), true);
    let mut script = Script::Combat(CombatScript::Nearest);
    let lost: Vec<_> = rollout.roll(&mut script, &jobs).into_iter().filter_map(Result::err).collect();
    assert_eq!(lost.len(), 1, "one link breaks: {lost:?}");
    assert_eq!(lost[0].error.kind, FailureKind::Died);
    assert_eq!(rollout.roll_all(&mut script, &jobs).unwrap().len(), 6);
    // Six games at first, and one more for the one that broke.
    assert_eq!(links.load(Ordering::Relaxed), 7);
}

#[test]
fn a_game_that_hangs_is_given_up_at_the_deadline() {
    let hanging = answering(|request| match request.request {
        Some(Asked::Ping(_)) => message(&pong(request)),
        _ => vec![],
    });
    let settings = Settings { timeout: Duration::from_millis(300), ..settings() };
    let worlds = StarCraft::at(hanging, SET, settings);
    let error = play(&worlds, 0).unwrap_err();
    assert_eq!(error.kind, FailureKind::TimedOut);
    assert_eq!(error.detail, "no answer to create_game within 0.3 s");
}

#[test]
fn what_is_no_battle_is_refused() {
    let worlds = at(endpoint(Options::default()), SET);
    let game = TaskSet::MatrixGame.tasks(Split::Training)[0];
    let error = worlds.build(game).err().unwrap();
    assert!(error.detail.starts_with("game-1 is no battle"), "{}", error.detail);
}
