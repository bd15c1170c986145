//! Real sockets, real certificates.

use super::{connect::EveryCall, *};
use crate::v1::{self, control_client::ControlClient, control_server};
use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa, KeyPair,
    date_time_ymd,
};
use std::{
    fs,
    io::Read as _,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    sync::Arc,
};
use tempfile::TempDir;
use tokio::{
    io::AsyncReadExt as _,
    sync::{Semaphore, oneshot},
};
use tonic::{Code, Request, Response, Status, service::Routes};

const TOKEN: &str = "0123456789abcdef";

/// A learner's Control that answers a status when it is let, and does nothing else.
#[derive(Clone)]
struct Patient(Arc<Semaphore>);

type Answer<T> = Result<Response<T>, Status>;

#[tonic::async_trait]
impl control_server::Control for Patient {
    async fn status(&self, _: Request<v1::StatusRequest>) -> Answer<v1::RunStatus> {
        self.0.acquire().await.unwrap().forget();
        Ok(Response::new(v1::RunStatus::default()))
    }
    async fn pause(&self, _: Request<v1::PauseRequest>) -> Answer<v1::RunStatus> {
        Err(Status::unimplemented(""))
    }
    async fn resume(&self, _: Request<v1::ResumeRequest>) -> Answer<v1::RunStatus> {
        Err(Status::unimplemented(""))
    }
    async fn evaluate(&self, _: Request<v1::EvaluateRequest>) -> Answer<v1::Evaluation> {
        Err(Status::unimplemented(""))
    }
    async fn checkpoint(&self, _: Request<v1::CheckpointRequest>) -> Answer<v1::CheckpointResponse> {
        Err(Status::unimplemented(""))
    }
    async fn stop(&self, _: Request<v1::StopRequest>) -> Answer<v1::RunStatus> {
        Err(Status::unimplemented(""))
    }
    async fn set(&self, _: Request<v1::SetRequest>) -> Answer<v1::RunStatus> {
        Err(Status::unimplemented(""))
    }
    type MetricsStream = tokio_stream::Pending<Result<v1::MetricsUpdate, Status>>;
    async fn metrics(&self, _: Request<v1::MetricsRequest>) -> Answer<Self::MetricsStream> {
        Err(Status::unimplemented(""))
    }
}

/// A server on an address of its own; it ends when this is dropped.
struct Listening {
    address: Address,
    answers: Arc<Semaphore>,
    _close: oneshot::Sender<()>,
}

async fn listen(address: &Address, access: Access, limits: ServeLimits) -> Listening {
    let incoming = Incoming::bind(address).await.unwrap();
    let address = incoming.address().clone();
    let (_, health) = tonic_health::server::health_reporter();
    let answers = Arc::new(Semaphore::new(0));
    let control = control_server::ControlServer::new(Patient(Arc::clone(&answers)));
    let routes = Routes::new(health).add_service(control);
    let (close, closed) = oneshot::channel::<()>();
    tokio::spawn(serve(incoming, access, limits, routes, async {
        let _ = closed.await;
    }));
    Listening { address, answers, _close: close }
}

fn loopback() -> Address {
    "tcp:127.0.0.1:0".parse().unwrap()
}

/// Certificates and keys in files.
struct Pki(TempDir);

/// The files of one certificate.
#[derive(Clone)]
struct Identity {
    certificate: PathBuf,
    key: PathBuf,
}

impl Pki {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn file(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.path().join(name);
        fs::write(&path, text).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        path
    }

    fn authority(&self, name: &str) -> (PathBuf, CertifiedIssuer<'static, KeyPair>) {
        let mut params = CertificateParams::new([]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(DnType::CommonName, name);
        let authority = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        (self.file(name, &authority.pem()), authority)
    }

    fn identity(&self, name: &str, by: &CertifiedIssuer<'_, KeyPair>, host: &str, expired: bool) -> Identity {
        let mut params = CertificateParams::new([host.to_owned()]).unwrap();
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        if expired {
            (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(2021, 1, 1));
        }
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, by).unwrap();
        Identity {
            certificate: self.file(&format!("{name}.pem"), &certificate.pem()),
            key: self.file(&format!("{name}.key"), &key.serialize_pem()),
        }
    }
}

fn files(server: &Identity, client_ca: Option<&Path>, token: Option<&Path>) -> AccessFiles {
    AccessFiles {
        token: token.map(Into::into),
        certificate: Some(server.certificate.clone()),
        key: Some(server.key.clone()),
        client_ca: client_ca.map(Into::into),
    }
}

fn credentials(ca: &Path, identity: Option<&Identity>, token: Option<&Path>) -> Credentials {
    let files = CredentialFiles {
        token: token.map(Into::into),
        ca: Some(ca.to_owned()),
        certificate: identity.map(|identity| identity.certificate.clone()),
        key: identity.map(|identity| identity.key.clone()),
    };
    Credentials::read(&files).unwrap()
}

#[tokio::test]
async fn a_socket_in_use_is_refused_and_a_stale_one_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let address = Address::Unix(folder.path().join("learner.sock"));
    let first = Incoming::bind(&address).await.unwrap();
    let Address::Unix(path) = &address else { unreachable!() };
    assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o600);
    assert!(matches!(Incoming::bind(&address).await, Err(ListenError::InUse(_))));
    drop(first);
    assert!(!path.exists());
    // What a killed learner leaves: a socket file without a listener.
    drop(std::os::unix::net::UnixListener::bind(path).unwrap());
    Incoming::bind(&address).await.unwrap();

    fs::write(path, "not a socket").unwrap();
    assert!(matches!(Incoming::bind(&address).await, Err(ListenError::NotASocket(_))));
    let long = Address::Unix(folder.path().join("x".repeat(100)));
    assert!(matches!(Incoming::bind(&long).await, Err(ListenError::PathTooLong { .. })));
}

#[tokio::test]
async fn a_port_in_use_and_a_name_are_refused() {
    let first = Incoming::bind(&loopback()).await.unwrap();
    assert!(matches!(Incoming::bind(first.address()).await, Err(ListenError::InUse(_))));
    let name = "tcp:localhost:0".parse().unwrap();
    assert!(matches!(Incoming::bind(&name).await, Err(ListenError::NotAnIp(_))));
}

#[tokio::test]
async fn an_absent_learner_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let address = Address::Unix(folder.path().join("learner.sock"));
    let error = connect(&address, &Credentials::token(TOKEN)).await.unwrap_err();
    assert!(error.may_pass());
    let error = error.to_string();
    assert!(error.starts_with("no learner answers on unix:"), "{error}");
    assert!(error.contains("No such file"), "{error}");
}

#[tokio::test]
async fn only_the_token_opens_socket_and_port() {
    let folder = tempfile::tempdir().unwrap();
    for address in [Address::Unix(folder.path().join("l.sock")), loopback()] {
        let server = listen(&address, Access::token(TOKEN), ServeLimits::default()).await;
        connect(&server.address, &Credentials::token(TOKEN)).await.unwrap();
        for wrong in ["0123456789abcdeF", "0123456789abcdef0", "", "no\nheader"] {
            let refused = connect(&server.address, &Credentials::token(wrong)).await;
            assert!(matches!(refused, Err(ConnectError::Token(_))), "{address} {wrong:?}");
        }
        let none = connect(&server.address, &Credentials::default()).await;
        assert!(matches!(none, Err(ConnectError::Token(_))), "{address}");
    }
}

#[test]
fn a_learner_that_would_let_anybody_in_does_not_listen() {
    let pki = Pki::new();
    let (ca, authority) = pki.authority("ca.pem");
    let server = pki.identity("server", &authority, "127.0.0.1", false);
    let token = pki.file("token", TOKEN);
    let (open, local): (Address, Address) = ("tcp:0.0.0.0:0".parse().unwrap(), loopback());
    let refused =
        |address: &Address, files: &AccessFiles| Access::over_tcp(address, files).unwrap_err().to_string();
    let token_alone = AccessFiles { token: Some(token.clone()), ..AccessFiles::default() };
    for address in [&open, &local] {
        let error = refused(address, &AccessFiles::default());
        assert!(error.contains("anybody could call; set learner.tls.certificate"), "{error}");
        assert!(refused(address, &files(&server, None, None)).contains("anybody could call"));
        let half = AccessFiles { key: None, ..files(&server, Some(&ca), None) };
        assert!(refused(address, &half).starts_with("learner.tls.key is not set"));
        let half = AccessFiles { client_ca: Some(ca.clone()), ..token_alone.clone() };
        assert!(refused(address, &half).starts_with("learner.tls.certificate is not set"));
        Access::over_tcp(address, &files(&server, Some(&ca), None)).unwrap();
        Access::over_tcp(address, &files(&server, None, Some(&token))).unwrap();
    }
    assert!(refused(&open, &token_alone).contains("in clear text; set learner.tls.certificate"));
    Access::over_tcp(&local, &token_alone).unwrap();

    let other = pki.identity("other", &authority, "127.0.0.1", false);
    let mixed = AccessFiles { key: Some(other.key), ..files(&server, Some(&ca), None) };
    assert!(refused(&local, &mixed).contains("learner.tls: "));
    let no_pem = AccessFiles { certificate: Some(token.clone()), ..files(&server, Some(&ca), None) };
    assert!(refused(&local, &no_pem).ends_with("token holds no certificate in PEM form"));
    let short = pki.file("short", "0123456789abcde\n");
    let too_short = AccessFiles { token: Some(short), ..AccessFiles::default() };
    assert!(refused(&local, &too_short).contains("holds no token of at least 16"));

    // Secrets that others can read.
    for secret in [&token, &server.key] {
        fs::set_permissions(secret, fs::Permissions::from_mode(0o640)).unwrap();
    }
    let error = refused(&local, &token_alone);
    assert!(error.contains("can be read by others (mode 640); run `chmod 600 "), "{error}");
    assert!(refused(&open, &files(&server, Some(&ca), None)).contains("server.key can be read by others"));
    let client = CredentialFiles { token: Some(token), ..CredentialFiles::default() };
    assert!(Credentials::read(&client).unwrap_err().to_string().contains("can be read by others"));
}

#[test]
fn a_caller_needs_all_that_belongs_together() {
    let pki = Pki::new();
    let (ca, authority) = pki.authority("ca.pem");
    let Identity { certificate, key } = pki.identity("client", &authority, "client", false);
    let (ca, certificate, key) = (Some(ca), Some(certificate), Some(key));
    let missing = |ca: &Option<PathBuf>, certificate: &Option<PathBuf>, key: &Option<PathBuf>| {
        let files = CredentialFiles {
            token: None,
            ca: ca.clone(),
            certificate: certificate.clone(),
            key: key.clone(),
        };
        Credentials::read(&files)
            .err()
            .map(|error| error.to_string().split_whitespace().next().unwrap().to_owned())
    };
    assert_eq!(missing(&ca, &certificate, &key), None);
    assert_eq!(missing(&ca, &None, &None), None);
    assert_eq!(missing(&ca, &certificate, &None).unwrap(), "--tls-key");
    assert_eq!(missing(&ca, &None, &key).unwrap(), "--tls-certificate");
    assert_eq!(missing(&None, &certificate, &key).unwrap(), "--tls-ca");
    let other = Some(pki.identity("other", &authority, "client", false).key);
    let unfit = CredentialFiles { token: None, ca, certificate, key: other };
    assert!(matches!(Credentials::read(&unfit), Err(CredentialsError::Tls(_))));
}

// Many times and on several threads: whichever of them hears a refusal first, it is told as what it is.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn both_sides_prove_who_they_are() {
    let pki = Pki::new();
    let (ca, authority) = pki.authority("ca.pem");
    let (other_ca, other_authority) = pki.authority("other-ca.pem");
    let server = pki.identity("server", &authority, "127.0.0.1", false);
    let client = pki.identity("client", &authority, "client", false);
    let access = Access::over_tcp(&loopback(), &files(&server, Some(&ca), None)).unwrap();
    let learner = listen(&loopback(), access, ServeLimits::default()).await;
    let address = &learner.address;
    connect(address, &credentials(&ca, Some(&client), None)).await.unwrap();

    // No certificate, one of another authority, one that has expired.
    let stranger = pki.identity("stranger", &other_authority, "client", false);
    let expired = pki.identity("expired", &authority, "client", true);
    for (identity, alert) in [
        (None, "CertificateRequired"),
        (Some(&stranger), "UnknownCA"),
        (Some(&expired), "CertificateExpired"),
    ] {
        for _ in 0..20 {
            match connect(address, &credentials(&ca, identity, None)).await.unwrap_err() {
                ConnectError::Certificate { reason, .. } => assert_eq!(reason, alert),
                other => panic!("{alert}: {other}"),
            }
        }
    }
    // The caller does not trust the learner: another authority, another host, expired.
    let untrusted = connect(address, &credentials(&other_ca, Some(&client), None)).await;
    assert!(matches!(untrusted, Err(ConnectError::Untrusted { .. })), "{untrusted:?}");
    for (host, expired) in [("10.9.8.7", false), ("127.0.0.1", true)] {
        let server = pki.identity("doubtful", &authority, host, expired);
        let access = Access::over_tcp(&loopback(), &files(&server, Some(&ca), None)).unwrap();
        let doubtful = listen(&loopback(), access, ServeLimits::default()).await;
        let untrusted = connect(&doubtful.address, &credentials(&ca, Some(&client), None)).await;
        assert!(matches!(untrusted, Err(ConnectError::Untrusted { .. })), "{untrusted:?}");
    }
    // No TLS at all.
    let plain = connect(address, &Credentials::token(TOKEN)).await;
    assert!(matches!(plain, Err(ConnectError::NoAnswer { .. })), "{plain:?}");
    // And after all of them, a caller with the token is still let in.
    connect(address, &credentials(&ca, Some(&client), None)).await.unwrap();
}

#[tokio::test]
async fn a_token_inside_tls_is_asked_for_as_well() {
    let pki = Pki::new();
    let (ca, authority) = pki.authority("ca.pem");
    let server = pki.identity("server", &authority, "127.0.0.1", false);
    let client = pki.identity("client", &authority, "client", false);
    let (token, wrong) = (pki.file("token", TOKEN), pki.file("wrong", "another-long-token"));
    for client_ca in [None, Some(&*ca)] {
        let access = Access::over_tcp(&loopback(), &files(&server, client_ca, Some(&token))).unwrap();
        let learner = listen(&loopback(), access, ServeLimits::default()).await;
        let identity = client_ca.map(|_| &client);
        connect(&learner.address, &credentials(&ca, identity, Some(&token))).await.unwrap();
        for wrong in [None, Some(&*wrong)] {
            let refused = connect(&learner.address, &credentials(&ca, identity, wrong)).await;
            assert!(matches!(refused, Err(ConnectError::Token(_))), "{refused:?}");
        }
    }
}

#[tokio::test]
async fn nothing_goes_to_another_host_in_clear_text() {
    let refused = connect(&"tcp:192.0.2.1:1".parse().unwrap(), &Credentials::token(TOKEN)).await;
    assert!(matches!(refused, Err(ConnectError::ClearText(_))), "{refused:?}");
}

#[tokio::test]
async fn another_user_is_not_heard() {
    if !rustix::process::geteuid().is_root() {
        println!("skipped: only root can become another user");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("l.sock");
    let server = listen(&Address::Unix(path.clone()), Access::token(TOKEN), ServeLimits::default()).await;
    // Folder and socket would keep others out already: here they are opened wide.
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o777)).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o777)).unwrap();
    let as_another = tokio::task::spawn_blocking(move || {
        // Of this thread alone, which ends with it.
        let thread = std::thread::spawn(move || {
            let another = rustix::process::Uid::from_raw(65534);
            rustix::thread::set_thread_res_uid(another, another, another).unwrap();
            let mut stream = std::os::unix::net::UnixStream::connect(path).unwrap();
            // A server would begin with its settings.
            stream.read(&mut [0; 64])
        });
        thread.join().unwrap()
    });
    assert!(matches!(as_another.await.unwrap(), Ok(0) | Err(_)), "closed without an answer");
    connect(&server.address, &Credentials::token(TOKEN)).await.unwrap();
}

/// Limits with so many places.
fn places(known: usize, strangers: usize) -> ServeLimits {
    let connections = PlaceLimits { known, strangers, ..ServeLimits::default().connections };
    ServeLimits { connections, ..ServeLimits::default() }
}

#[tokio::test]
async fn no_more_connections_than_there_are_places() {
    let server = listen(&loopback(), Access::token(TOKEN), places(2, 8)).await;
    let credentials = Credentials::token(TOKEN);
    let first = connect(&server.address, &credentials).await.unwrap();
    let second = connect(&server.address, &credentials).await.unwrap();
    let third = connect(&server.address, &credentials).await.unwrap_err();
    assert!(matches!(third, ConnectError::Busy { .. }), "{third:?}");
    assert!(third.to_string().contains("2 connections are open, which is the most there may be"), "{third}");
    drop(first);
    let in_time = tokio::time::timeout(Duration::from_secs(60), async {
        while connect(&server.address, &credentials).await.is_err() {
            tokio::task::yield_now().await;
        }
    });
    in_time.await.expect("a place is free again");
    drop(second);
}

#[tokio::test]
async fn silent_connections_keep_no_known_caller_out_and_are_closed() {
    let pki = Pki::new();
    let (ca, authority) = pki.authority("ca.pem");
    let server = pki.identity("server", &authority, "127.0.0.1", false);
    let client = pki.identity("client", &authority, "client", false);
    let tls = Access::over_tcp(&loopback(), &files(&server, Some(&ca), None)).unwrap();
    for (access, credentials) in
        [(Access::token(TOKEN), Credentials::token(TOKEN)), (tls, credentials(&ca, Some(&client), None))]
    {
        let learner = listen(&loopback(), access, places(2, 4)).await;
        let Address::Tcp { host, port } = &learner.address else { unreachable!() };
        let before = connect(&learner.address, &credentials).await.unwrap();
        let mut silent = Vec::new();
        for _ in 0..600 {
            silent.push(tokio::net::TcpStream::connect((host.as_str(), *port)).await.unwrap());
        }
        let after = connect(&learner.address, &credentials).await.unwrap();
        // All but the newest few were closed for those that came after them.
        for stream in &mut silent[..590] {
            let end = async { while stream.read(&mut [0; 64]).await.is_ok_and(|read| read > 0) {} };
            tokio::time::timeout(Duration::from_secs(60), end).await.expect("it is closed");
        }
        for known in [before, after] {
            let mut hurried = Request::new(v1::PauseRequest {});
            hurried.set_timeout(Duration::from_secs(60));
            let answer = ControlClient::new(known).pause(hurried).await.unwrap_err();
            assert_eq!(answer.code(), Code::Unimplemented, "{answer}");
        }
    }
}

#[tokio::test]
async fn a_caller_that_does_not_show_the_token_in_time_is_closed() {
    let mut limits = places(2, 4);
    limits.connections.deadline = Duration::from_millis(50);
    let learner = listen(&loopback(), Access::token(TOKEN), limits).await;
    let known = connect(&learner.address, &Credentials::token(TOKEN)).await.unwrap();
    let Address::Tcp { host, port } = &learner.address else { unreachable!() };
    let mut silent = tokio::net::TcpStream::connect((host.as_str(), *port)).await.unwrap();
    let end = async { while silent.read(&mut [0; 64]).await.is_ok_and(|read| read > 0) {} };
    tokio::time::timeout(Duration::from_secs(60), end).await.expect("it is closed");
    let answer = ControlClient::new(known).pause(v1::PauseRequest {}).await.unwrap_err();
    assert_eq!(answer.code(), Code::Unimplemented, "a known caller stays: {answer}");
}

#[tokio::test]
async fn no_more_calls_than_are_taken_on_and_each_ends() {
    let limits = ServeLimits { calls: 2, ..ServeLimits::default() };
    let server = listen(&loopback(), Access::token(TOKEN), limits).await;
    let client = connect(&server.address, &Credentials::token(TOKEN)).await.unwrap();
    let mut control = ControlClient::new(client);
    let mut waiting = Vec::new();
    for _ in 0..2 {
        let mut control = control.clone();
        waiting.push(tokio::spawn(async move { control.status(v1::StatusRequest {}).await }));
    }
    // Both wait; the next caller is told at once.
    let in_time = tokio::time::timeout(Duration::from_secs(60), async {
        while control.pause(v1::PauseRequest {}).await.unwrap_err().code() != Code::ResourceExhausted {
            tokio::task::yield_now().await;
        }
    });
    in_time.await.expect("no further call is taken on");
    server.answers.add_permits(2);
    for waiting in waiting {
        waiting.await.unwrap().unwrap();
    }
    // No answer comes to this one: its own deadline ends it.
    let mut hurried = Request::new(v1::StatusRequest {});
    hurried.set_timeout(Duration::from_millis(20));
    let late = control.status(hurried).await.unwrap_err();
    assert!(matches!(late.code(), Code::DeadlineExceeded | Code::Cancelled), "{late}");
}

#[test]
fn every_call_but_a_stream_has_a_deadline() {
    use tonic::{GrpcMethod, service::Interceptor as _};
    let deadline = |service, method| {
        let mut request = Request::new(());
        request.extensions_mut().insert(GrpcMethod::new(service, method));
        let request = EveryCall::default().call(request).unwrap();
        request.metadata().get("grpc-timeout").map(|value| value.to_str().unwrap().to_owned())
    };
    assert_eq!(deadline("rit.v1.Control", "Status").unwrap(), "10000000u");
    assert_eq!(deadline("rit.v1.Control", "Evaluate").unwrap(), "600000m");
    assert_eq!(deadline("rit.v1.Rollout", "Join"), None);
    assert_eq!(deadline("rit.v1.Control", "Metrics"), None);
}
