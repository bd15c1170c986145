//! The endpoint's WebSocket, as clients of all kinds speak to it.

#![allow(clippy::panic, clippy::unwrap_used, clippy::expect_used, reason = "test code")]

mod common;

use common::endpoint;
use prost::Message as _;
use rit_starcraft::{
    endpoint::{Endpoint, Options},
    messages::{Request, RequestPing, RequestQuit, Response, Status, request::Request as Asked},
};
use std::{
    io::{Read as _, Write as _},
    net::{SocketAddr, TcpStream},
    thread,
};
use tungstenite::{
    Message, WebSocket,
    protocol::frame::{
        Frame,
        coding::{Data, OpCode},
    },
};

fn connect(address: SocketAddr) -> WebSocket<TcpStream> {
    let stream = TcpStream::connect(address).unwrap();
    tungstenite::client(format!("ws://{address}/sc2api"), stream).unwrap().0
}

/// A ping whose number makes it no UTF-8.
fn ping() -> (Vec<u8>, u32) {
    let id = 0xffff_fff0;
    let request = Request { request: Some(Asked::Ping(RequestPing {})), id: Some(id) }.encode_to_vec();
    assert!(std::str::from_utf8(&request).is_err());
    (request, id)
}

fn answer(socket: &mut WebSocket<TcpStream>) -> Response {
    let Message::Binary(bytes) = socket.read().unwrap() else { panic!("not binary") };
    Response::decode(bytes).unwrap()
}

#[test]
fn text_that_is_none_and_messages_in_pieces_are_understood() {
    let mut socket = connect(endpoint(Options::default()));
    let (request, id) = ping();
    let send = |socket: &mut WebSocket<TcpStream>, part: &[u8], opcode, last| {
        let frame = Frame::message(part.to_vec(), OpCode::Data(opcode), last);
        socket.send(Message::Frame(frame)).unwrap();
    };
    send(&mut socket, &request, Data::Text, true);
    assert_eq!((answer(&mut socket).id(), id), (id, id));
    let (first, rest) = request.split_at(3);
    send(&mut socket, first, Data::Binary, false);
    // Between the pieces something else may come.
    socket.send(Message::Ping("there?".into())).unwrap();
    send(&mut socket, rest, Data::Continue, true);
    assert!(matches!(socket.read().unwrap(), Message::Pong(said) if said == "there?"));
    assert_eq!(answer(&mut socket).id(), id);
    // A piece of nothing: the client is let go.
    send(&mut socket, rest, Data::Continue, true);
    assert!(socket.read().is_err());
}

#[test]
fn a_client_that_wants_something_else_gets_404() {
    let address = endpoint(Options::default());
    for (path, begins) in [("/", "HTTP/1.1 404"), ("/sc2api", "HTTP/1.1 101")] {
        let mut stream = TcpStream::connect(address).unwrap();
        let request = format!(
            "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(String::from_utf8_lossy(&answer), begins);
    }
    // Garbage in place of a handshake, or of a frame, ends that connection alone.
    let mut rude = TcpStream::connect(address).unwrap();
    rude.write_all(&[0xff; 300]).unwrap();
    let mut socket = connect(address);
    socket.get_mut().write_all(&[0xff; 300]).unwrap();
    assert!(socket.read().is_err());
    let mut socket = connect(address);
    socket.send(Message::Binary(ping().0.into())).unwrap();
    assert_eq!(answer(&mut socket).status(), Status::Launched);
}

#[test]
fn as_a_game_it_ends_when_a_client_asks_it_to_quit() {
    let endpoint = Endpoint::bind(([127, 0, 0, 1], 0).into(), Options::default()).unwrap();
    let address = endpoint.address().unwrap();
    let served = thread::spawn(move || endpoint.serve_as_a_game());
    // One client closes its connection and says nothing; the next ends the game.
    drop(connect(address));
    let mut socket = connect(address);
    let quit = Request { request: Some(Asked::Quit(RequestQuit {})), id: Some(1) }.encode_to_vec();
    socket.send(Message::Binary(quit.into())).unwrap();
    assert_eq!(answer(&mut socket).status(), Status::Quit);
    served.join().unwrap();
}
