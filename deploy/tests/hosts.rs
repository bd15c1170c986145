//! One learner, actors on other hosts: the same weights as on one host, whatever the links between them do.
//!
//! Hosts are network namespaces of this one, which takes root and `ip`; without them those tests say so and pass.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output, rit};
use rit_env::{
    Script, Split, TaskSet,
    rollout::{Job, Rollout},
};
use rit_episode::{
    Choice,
    wire::{self, Frame, PayloadLayout},
};
use rit_proto::{
    transport::{Client, CredentialFiles, Credentials, connect},
    v1::{
        self, actor_message::Message as Said, episodes_client::EpisodesClient,
        learner_message::Message as Heard, rollout_client::RolloutClient,
    },
};
use serde_json::Value;
use std::{
    fs,
    io::{Read, Write as _},
    net::{Shutdown, TcpListener, TcpStream},
    process::{Child, Command, Stdio},
    sync::{
        LazyLock,
        atomic::{AtomicU32, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};
use tokio::sync::mpsc;
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::{Code, Status, Streaming};

/// 150 episodes, of which the last 118 bring an update each.
const RUN: &[&str] = &["matrix-game", "--seed", "3", "--steps", "300"];

/// Far beyond what any step of a test takes on a slow machine: reached only when something hangs.
const DEADLINE: Duration = Duration::from_secs(120);

/// The summary of the same run on one host, through shared memory.
static ONE_HOST: LazyLock<Value> =
    LazyLock::new(|| RunFolder::new().train(&[RUN, &["--actors", "1"]].concat()));

#[track_caller]
fn as_on_one_host(summary: &Value) {
    for key in ["weights_digest", "env_steps", "episodes", "updates", "evaluation"] {
        assert_eq!(summary[key], ONE_HOST[key], "{key}");
    }
}

/// An actor process that is killed when dropped.
struct Actor(Child);

impl Actor {
    fn start(mut command: Command, address: &str, arguments: &[&str]) -> Self {
        command.args(["actor", "--address", address]).args(arguments).stderr(Stdio::piped());
        Self(command.spawn().unwrap())
    }

    /// Waits until it ends, which must be because the learner said farewell.
    fn finish(mut self) {
        let begun = Instant::now();
        while self.0.try_wait().unwrap().is_none() {
            assert!(begun.elapsed() < DEADLINE, "an actor stays");
            thread::yield_now();
        }
        let status = self.0.wait().unwrap();
        let mut stderr = String::new();
        self.0.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
        assert!(status.success(), "{status:?}: {stderr}");
    }
}

impl Drop for Actor {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Two hosts with one link between them: the learner's, 10.77.0.1, and the actors', 10.77.0.2.
struct Hosts {
    learner: String,
    actors: String,
}

fn ip(arguments: &[&str]) -> bool {
    let done = Command::new("ip").args(arguments).stderr(Stdio::null()).status();
    done.is_ok_and(|status| status.success())
}

impl Hosts {
    fn new() -> Option<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let (pid, n) = (std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let hosts = Self { learner: format!("rit-{pid}-{n}-l"), actors: format!("rit-{pid}-{n}-a") };
        let (learner, actors) = (&*hosts.learner, &*hosts.actors);
        let made = ip(&["netns", "add", learner])
            && ip(&["netns", "add", actors])
            && ip(&[
                "-n", learner, "link", "add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", actors,
            ])
            && [(learner, "10.77.0.1/24"), (actors, "10.77.0.2/24")].iter().all(|(host, address)| {
                ip(&["-n", host, "addr", "add", address, "dev", "eth0"])
                    && ip(&["-n", host, "link", "set", "lo", "up"])
                    && ip(&["-n", host, "link", "set", "eth0", "up"])
            });
        if !made {
            println!("skipped: network namespaces take root and `ip` (Debian's iproute2)");
        }
        made.then_some(hosts)
    }

    /// `rit` on one of the hosts.
    fn rit_on(&self, host: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", host, env!("CARGO_BIN_EXE_rit")]).stdin(Stdio::null());
        command
    }

    fn link(&self, state: &str) {
        assert!(ip(&["-n", &self.actors, "link", "set", "eth0", state]));
    }

    /// Lets so much through in either direction; false where the kernel cannot.
    fn slow_down(&self, rate: &str) -> bool {
        [&self.learner, &self.actors].into_iter().all(|host| {
            let limit = [
                "qdisc", "add", "dev", "eth0", "root", "tbf", "rate", rate, "burst", "32kbit", "latency",
                "50ms",
            ];
            let done = Command::new("tc").args(["-n", host]).args(limit).stderr(Stdio::null()).status();
            done.is_ok_and(|status| status.success())
        })
    }
}

impl Drop for Hosts {
    fn drop(&mut self) {
        for host in [&self.learner, &self.actors] {
            ip(&["netns", "del", host]);
        }
    }
}

/// A learner on the one host and so many actors on the other, with certificates.
struct Cluster {
    hosts: Hosts,
    folder: RunFolder,
    actors: usize,
}

impl Cluster {
    fn new(actors: usize) -> Option<Self> {
        let cluster = Self { hosts: Hosts::new()?, folder: RunFolder::new(), actors };
        let made = output(&["certificates", "--out", &cluster.file(""), "--host", "10.77.0.1"]);
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        Some(cluster)
    }

    fn file(&self, name: &str) -> String {
        self.folder.path().join("certificates").join(name).display().to_string()
    }

    fn start(&self, settings: &[&str]) -> (common::Train, Vec<Actor>) {
        let mut arguments: Vec<String> = RUN.iter().map(|&word| word.to_owned()).collect();
        arguments.extend(["--json", "--actors", "0"].map(str::to_owned));
        let mut set = |setting: String| arguments.extend(["--set".to_owned(), setting]);
        set(format!("actors.remote={}", self.actors));
        set("learner.listen=tcp:10.77.0.1:50051".into());
        set(format!("learner.tls.certificate={}", self.file("learner.pem")));
        set(format!("learner.tls.key={}", self.file("learner.key")));
        set(format!("learner.tls.client_ca={}", self.file("ca.pem")));
        settings.iter().for_each(|&setting| set(setting.to_owned()));
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let train = self.folder.start_as(self.hosts.rit_on(&self.hosts.learner), &arguments);
        let address = self.folder.remote_address();
        let tls = [
            ("--tls-ca", self.file("ca.pem")),
            ("--tls-certificate", self.file("client.pem")),
            ("--tls-key", self.file("client.key")),
        ];
        let actor = |index: usize| {
            let name = format!("host1-actor-{index}");
            let mut arguments = vec!["--name", &name];
            arguments.extend(tls.iter().flat_map(|(option, file)| [*option, file]));
            Actor::start(self.hosts.rit_on(&self.hosts.actors), &address, &arguments)
        };
        (train, (0..self.actors).map(actor).collect())
    }
}

fn env_steps(status: &Value) -> u64 {
    status["env_steps"].as_u64().unwrap()
}

/// Every episode that was handed out is accounted for.
#[track_caller]
fn balanced(status: &Value) {
    let ledger = &status["ledger"];
    let rejected: u64 = ledger["rejected"].as_object().unwrap().values().filter_map(Value::as_u64).sum();
    let count = |key: &str| ledger[key].as_u64().unwrap();
    assert_eq!(count("handed_out"), count("inserted") + count("outstanding") + rejected, "{ledger}");
}

#[test]
fn actors_on_another_host_bring_the_same_weights() {
    let Some(cluster) = Cluster::new(2) else { return };
    let (mut train, actors) = cluster.start(&[]);
    train.wait_for("both actors at work", |status| {
        let actors = status["actors"].as_array().unwrap();
        actors.len() == 2 && actors.iter().all(|a| a["remote"] == true && a["episodes"].as_u64() > Some(0))
    });
    as_on_one_host(&train.finish());
    actors.into_iter().for_each(Actor::finish);
}

#[test]
fn a_link_that_is_cut_and_heals_loses_and_doubles_nothing() {
    let Some(cluster) = Cluster::new(1) else { return };
    let (mut train, actors) = cluster.start(&["actors.heartbeat_timeout_ms=2000", "actors.remote=2"]);
    train.wait_for("training", |status| env_steps(status) > 20);
    cluster.hosts.link("down");
    let cut = train.wait_for("the silence to be noticed", |status| {
        status["actors"].as_array().unwrap().iter().all(|actor| actor["hung"] == true)
    });
    balanced(&cut);
    assert!(env_steps(&cut) < 300, "the cut came before the end");
    cluster.hosts.link("up");
    let summary = train.finish();
    as_on_one_host(&summary);
    actors.into_iter().for_each(Actor::finish);
    let log = fs::read_to_string(cluster.folder.run_dir().join("logs/learner.log")).unwrap();
    assert!(log.contains("an actor hangs"), "{log}");
}

#[test]
fn a_slow_link_changes_nothing() {
    let Some(cluster) = Cluster::new(1) else { return };
    if !cluster.hosts.slow_down("50mbit") {
        println!("skipped: this kernel has no token bucket filter (tc tbf)");
        return;
    }
    let (train, actors) = cluster.start(&[]);
    let summary = train.finish();
    as_on_one_host(&summary);
    actors.into_iter().for_each(Actor::finish);
}

/// A run whose learner listens on loopback for those that have the token; and the token's file.
fn on_loopback(folder: &RunFolder) -> (common::Train, String) {
    let token = folder.secret("token").display().to_string();
    let token_file = format!("learner.token_file={token}");
    let listen =
        ["--set", "learner.listen=tcp:127.0.0.1:0", "--set", &token_file, "--set", "actors.remote=1"];
    (folder.start(&[RUN, &["--actors", "0"], &listen[..]].concat()), token)
}

#[test]
fn no_more_actors_of_other_hosts_than_are_wanted() {
    let folder = RunFolder::new();
    let (mut train, token) = on_loopback(&folder);
    let address = folder.remote_address();
    let actor = Actor::start(rit(&[]), &address, &["--token-file", &token, "--name", "one"]);
    train.wait_for("it", |status| !status["actors"].as_array().unwrap().is_empty());
    let another = output(&["actor", "--address", &address, "--token-file", &token, "--name", "two"]);
    assert_eq!(another.status.code(), Some(2));
    let stderr = String::from_utf8_lossy(&another.stderr);
    assert!(stderr.contains("the learner takes 1 of those; set actors.remote higher"), "{stderr}");
    as_on_one_host(&train.finish());
    actor.finish();
}

#[test]
fn a_link_that_breaks_in_the_middle_of_frames_loses_and_doubles_nothing() {
    // Enough for some episodes each, and no multiple of any frame.
    const BYTES_OF_A_LINK: usize = 5003;
    let folder = RunFolder::new();
    let (train, token) = on_loopback(&folder);
    let learner = folder.remote_address().trim_start_matches("tcp:").to_owned();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let through = format!("tcp:{}", listener.local_addr().unwrap());
    static LINKS: AtomicUsize = AtomicUsize::new(0);
    thread::spawn(move || {
        for actor in listener.incoming() {
            LINKS.fetch_add(1, Ordering::Relaxed);
            let Ok(learner) = TcpStream::connect(&learner) else { return };
            pass(actor.unwrap(), learner, BYTES_OF_A_LINK);
        }
    });
    let actor = Actor::start(rit(&[]), &through, &["--token-file", &token]);
    as_on_one_host(&train.finish());
    assert!(LINKS.load(Ordering::Relaxed) > 3, "links broke: {LINKS:?}");
    drop(actor);
}

/// What an actor of the test's own hears from the learner, and how it speaks to it.
struct Conversation {
    to_learner: mpsc::Sender<v1::ActorMessage>,
    from_learner: Streaming<v1::LearnerMessage>,
}

impl Conversation {
    /// Says Hello as the process with this number.
    async fn join(client: Client, instance: u64) -> Result<Self, Status> {
        let (to_learner, messages) = mpsc::channel(8);
        let hello = v1::Hello {
            name: "forger".into(),
            layout_version: wire::LAYOUT_VERSION,
            instance,
            remote: true,
            ..v1::Hello::default()
        };
        to_learner.send(v1::ActorMessage { message: Some(Said::Hello(hello)) }).await.unwrap();
        let from_learner = RolloutClient::new(client).join(ReceiverStream::new(messages)).await?.into_inner();
        Ok(Self { to_learner, from_learner })
    }

    async fn say(&self, message: Said) {
        self.to_learner.send(v1::ActorMessage { message: Some(message) }).await.unwrap();
    }

    async fn hear(&mut self) -> Option<Heard> {
        self.from_learner.message().await.unwrap().map(|message| message.message.unwrap())
    }
}

async fn call(folder: &RunFolder, token: String) -> Client {
    let address = folder.remote_address().parse().unwrap();
    let token = CredentialFiles { token: Some(token.into()), ..CredentialFiles::default() };
    connect(&address, &Credentials::read(&token).unwrap()).await.unwrap()
}

#[tokio::test]
async fn an_actor_that_comes_back_takes_its_place_over() {
    let folder = RunFolder::new();
    let (mut train, token) = on_loopback(&folder);
    let client = call(&folder, token).await;
    let mut first = Conversation::join(client.clone(), 7).await.unwrap();
    let Some(Heard::Welcome(v1::Welcome { actor, .. })) = first.hear().await else { panic!("no welcome") };
    let Some(Heard::Lease(lease)) = first.hear().await else { panic!("no lease") };
    // Of the same name, and another process; then the same process, of whose broken link the learner knows nothing.
    let other = Conversation::join(client.clone(), 8).await.err().unwrap();
    assert!(matches!(other.code(), Code::AlreadyExists | Code::FailedPrecondition), "{other}");
    let mut again = Conversation::join(client, 7).await.unwrap();
    let Some(Heard::Welcome(welcome)) = again.hear().await else { panic!("no welcome") };
    assert_ne!(welcome.actor, actor);
    let Some(Heard::Lease(same)) = again.hear().await else { panic!("no lease") };
    assert_eq!(same.episodes, lease.episodes, "what it had is handed out again");
    assert!(first.hear().await.is_none(), "its former session is over");
    let status = train.wait_for("one actor", |status| status["actors"].as_array().unwrap().len() == 1);
    assert_eq!(status["ledger"]["rejected"]["actor_gone"], Value::from(lease.episodes.len()));
    balanced(&status);
    drop((first.to_learner, again.to_learner));
}

/// Says that all of these episodes were lost.
fn all_lost(lease: &v1::Lease) -> Said {
    let (reason, detail) = ("environment_died".to_owned(), "the game has ended".to_owned());
    let loss = v1::Loss { reason, episodes: lease.episodes.clone(), detail };
    Said::Done(v1::Done { lease: lease.lease, losses: vec![loss], cpu_ms: 0 })
}

#[tokio::test]
async fn what_environments_lose_is_counted_by_its_reason_and_handed_out_again() {
    let folder = RunFolder::new();
    let (mut train, token) = on_loopback(&folder);
    let mut actor = Conversation::join(call(&folder, token).await, 7).await.unwrap();
    let Some(Heard::Welcome(_)) = actor.hear().await else { panic!("no welcome") };
    let Some(Heard::Lease(lease)) = actor.hear().await else { panic!("no lease") };
    actor.say(all_lost(&lease)).await;
    let Some(Heard::Lease(again)) = actor.hear().await else { panic!("no lease") };
    assert_eq!(again.episodes, lease.episodes);
    // An actor that gives up says so first, and is given nothing more.
    actor.say(Said::Leaving(v1::Leaving {})).await;
    actor.say(all_lost(&again)).await;
    assert!(matches!(actor.hear().await, Some(Heard::Farewell(_))));
    let lost = 2 * lease.episodes.len();
    let status = train.wait_for("losses", |status| status["ledger"]["rejected"]["environment_died"] == lost);
    balanced(&status);
    let said = |happening: &&Value| happening["what"].as_str().unwrap().contains("the game has ended");
    let happenings = status["happenings"].as_array().unwrap();
    let warnings: Vec<_> = happenings.iter().filter(said).map(|it| &it["warning"]).collect();
    assert_eq!(warnings, [true, false], "the first is said aloud: {happenings:?}");
    let shown = output(&["ctl", "--run", folder.run_dir().to_str().unwrap(), "status"]).stdout;
    let shown = String::from_utf8(shown).unwrap();
    assert!(shown.contains(&format!("taken back         environment died {lost}")), "{shown}");
}

#[tokio::test]
async fn what_comes_twice_or_is_forged_is_counted_and_not_let_in() {
    let folder = RunFolder::new();
    let (mut train, token) = on_loopback(&folder);
    let client = call(&folder, token).await;
    let mut actor = Conversation::join(client.clone(), 7).await.unwrap();
    let Some(Heard::Welcome(welcome)) = actor.hear().await else { panic!("no welcome") };
    let Some(Heard::Lease(lease)) = actor.hear().await else { panic!("no lease") };

    let config = rit_config::resolve(&welcome.config, "welcome", &[]).unwrap();
    let layout = PayloadLayout::new(TaskSet::MatrixGame.dims());
    let tasks = TaskSet::MatrixGame.tasks(Split::Training);
    let mut rollout = Rollout::new(tasks, rit_worlds::factory(&config), config.seed, true);
    let job = Job {
        number: lease.episodes[0],
        weights_version: lease.weights_version,
        choice: Choice::EpsilonGreedy(lease.epsilon),
        task: None,
    };
    let episode = rollout.roll(&mut Script::Random, &[job]).remove(0).unwrap();
    let run_id = welcome.run_id.try_into().unwrap();
    let frame = |run_id, actor| {
        let mut frame = Frame::new(&layout);
        wire::encode(&episode, &layout, run_id, actor, &mut frame).unwrap();
        v1::Frame { header: frame.header.as_bytes().to_vec().into(), payload: frame.payload.into() }
    };
    let good = frame(run_id, welcome.actor);
    let forged = [
        // Half a header; another run's; another actor's; half a payload; one bit changed.
        v1::Frame { header: good.header.slice(..40), ..good.clone() },
        frame([7; 16], welcome.actor),
        frame(run_id, welcome.actor + 1),
        v1::Frame { payload: good.payload.slice(..good.payload.len() / 2), ..good.clone() },
        v1::Frame { payload: good.payload.iter().map(|byte| byte ^ 1).collect(), ..good.clone() },
    ];
    let all: Vec<_> = forged.into_iter().chain([good.clone(), good]).collect();
    let count = all.len() as u64;
    // The stream stays open until all has been read.
    let frames = tokio_stream::iter(all).chain(tokio_stream::pending());
    let mut receipts = EpisodesClient::new(client).send(frames).await.unwrap().into_inner();
    while receipts.message().await.unwrap().unwrap().frames < count {}

    let status = train.wait_for("the ledger", |status| status["ledger"]["inserted"] == 1);
    let refused = status["ledger"]["frames_refused"].as_object().unwrap();
    let reasons: Vec<_> =
        refused.iter().map(|(reason, count)| (reason.as_str(), count.as_u64().unwrap())).collect();
    // The second of the same frame, and the other actor's.
    let expected = [("checksum", 1), ("header", 1), ("length", 1), ("not_outstanding", 2), ("run", 1)];
    assert_eq!(reasons, expected);
    balanced(&status);
}

/// Passes bytes on in both directions until so many have gone from the one side to the other; then the link is gone.
fn pass(mut actor: TcpStream, mut learner: TcpStream, bytes: usize) {
    let (mut back_from, mut back_to) = (learner.try_clone().unwrap(), actor.try_clone().unwrap());
    let back = thread::spawn(move || {
        let _ = std::io::copy(&mut back_from, &mut back_to);
        let _ = back_to.shutdown(Shutdown::Both);
    });
    let mut left = bytes;
    let mut buffer = [0; 4096];
    while left > 0 {
        let most = left.min(buffer.len());
        let Ok(read @ 1..) = actor.read(&mut buffer[..most]) else { break };
        if learner.write_all(&buffer[..read]).is_err() {
            break;
        }
        left -= read;
    }
    for stream in [actor, learner] {
        let _ = stream.shutdown(Shutdown::Both);
    }
    back.join().unwrap();
}
