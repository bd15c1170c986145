//! The game's messages, generated from `proto/starcraft.proto`.

#![allow(missing_docs, reason = "the game's own names; the .proto file says what is what")]

include!(concat!(env!("OUT_DIR"), "/sc2api_protocol.rs"));

/// Requests and their responses have the same names.
macro_rules! named {
    ($kind:ty, $help:literal) => {
        impl $kind {
            #[doc = $help]
            pub fn name(&self) -> &'static str {
                match self {
                    Self::CreateGame(_) => "create_game",
                    Self::JoinGame(_) => "join_game",
                    Self::RestartGame(_) => "restart_game",
                    Self::LeaveGame(_) => "leave_game",
                    Self::Quit(_) => "quit",
                    Self::GameInfo(_) => "game_info",
                    Self::Observation(_) => "observation",
                    Self::Action(_) => "action",
                    Self::Step(_) => "step",
                    Self::Data(_) => "data",
                    Self::SaveReplay(_) => "save_replay",
                    Self::Ping(_) => "ping",
                    Self::Debug(_) => "debug",
                }
            }
        }
    };
}

named!(request::Request, "What the request is called, in errors.");
named!(response::Response, "The name of the request that it answers.");
