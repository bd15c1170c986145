//! MAT choosing joint actions, agent after agent, for several running episodes at once.
//!
//! All that does not depend on actions is made at once. Then come the agents: the first of every episode together, then
//! the second, and so on, each given its own token and the keys and values of those before it.

use super::{DecoderBlock, Mat, MultiHead, Projected, normalized_sum};
use crate::{
    Rows,
    networks::Actor,
    on_policy::{self, ActorCritic as _, Inputs},
};
use rit_episode::{Policy, Turn};
use rit_nn::{
    View,
    attention::{Group, Visible},
    tape::{Stock, Tape, Var},
};
use std::sync::Arc;

/// A policy of the networks: holds only what acting needs.
pub struct MatActing {
    mat: Arc<Mat>,
    params: Vec<f32>,
    inputs: Inputs,
    places: Vec<Place>,
    stock: Stock,
    logits: Vec<f32>,
}

/// A place in the decision order: the agents there choose together.
#[derive(Default)]
struct Place {
    /// The turns that have an agent there.
    turns: Vec<usize>,
    /// These agents' rows.
    rows: Vec<usize>,
    /// Each of these alone, over the rows of its team up to its own.
    groups: Vec<Group>,
}

impl MatActing {
    /// Acts with the given acting parameters (see [`on_policy::ActorCritic::acting`]).
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    pub fn new(mat: Arc<Mat>, params: &[f32]) -> Self {
        let mut acting = Self {
            mat,
            params: Vec::new(),
            inputs: Inputs::default(),
            places: Vec::new(),
            stock: Stock::default(),
            logits: Vec::new(),
        };
        acting.set_params(params);
        acting
    }

    /// The logits of the last [`Policy::act`], turn after turn, `[agent rows, A]`: each row's given the actions that
    /// were chosen before it.
    pub fn logits(&self) -> &[f32] {
        &self.logits
    }
}

impl Actor for MatActing {
    fn utilities(&self) -> &[f32] {
        &self.logits
    }

    fn set_params(&mut self, params: &[f32]) {
        assert_eq!(params.len(), self.mat.acting().len(), "the parameters that acting needs");
        self.params.clear();
        self.params.extend_from_slice(params);
    }
}

impl Policy for MatActing {
    fn begin(&mut self, _: usize, _: usize) {}

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        let Self { mat, params, inputs, places, stock, logits } = self;
        inputs.rows.fill_from_turns(turns);
        mat.fill(inputs);
        *places = Place::all(&inputs.rows);
        let n_actions = mat.config.n_actions;
        logits.clear();
        logits.resize(inputs.rows.agent_rows() * n_actions, 0.0);

        let mut tape = Tape::inference(params, std::mem::take(stock));
        let observations = tape.constant(View::dense(&inputs.observations, mat.config.slots.width()));
        let encoded = mat.encode(&mut tape, observations, &inputs.teams);
        let decoding = Decoding::new(mat, &mut tape, encoded, &inputs.one_hots);
        for (index, place) in places.iter().enumerate() {
            let token = |&turn: &usize| match index {
                0 => 0,
                _ => usize::from(turns[turn].actions[index - 1]) + 1,
            };
            let tokens: Vec<usize> = place.turns.iter().map(token).collect();
            let of_rows = decoding.decide(&mut tape, place, &tokens);
            for (at, (&row, &turn)) in place.rows.iter().zip(&place.turns).enumerate() {
                let of_row = row * n_actions..(row + 1) * n_actions;
                logits[of_row.clone()].copy_from_slice(tape.view(of_rows).row(at));
                let (turn, available) = (&mut turns[turn], &inputs.rows.available[of_row.clone()]);
                turn.actions[index] = on_policy::choose(&logits[of_row], available, turn.exploration);
            }
            tape.free(of_rows);
        }
        *stock = tape.into_stock();
    }
}

impl Place {
    fn all(rows: &Rows) -> Vec<Self> {
        let longest = rows.groups.iter().map(|group| group.queries.len()).max().unwrap_or(0);
        let mut all: Vec<Self> = (0..longest).map(|_| Self::default()).collect();
        for (turn, group) in rows.groups.iter().enumerate() {
            for (place, row) in all.iter_mut().zip(group.queries.clone()) {
                let at = place.rows.len();
                place.turns.push(turn);
                place.rows.push(row);
                place.groups.push(Group { queries: at..at + 1, keys: group.queries.start..row + 1 });
            }
        }
        all
    }
}

/// What the decoder makes before the first action, and what it keeps from one place to the next.
struct Decoding<'m> {
    mat: &'m Mat,
    encoded: Var,
    /// The tokens' embeddings, (A + 1, e).
    tokens: Var,
    /// Their projections by the first block.
    of_tokens: Option<Projected>,
    /// Of each block.
    caches: Vec<Cache>,
}

impl<'m> Decoding<'m> {
    fn new<'a>(mat: &'m Mat, tape: &mut Tape<'a>, encoded: Var, one_hots: &'a [f32]) -> Self {
        let tokens = mat.embed_tokens(tape, one_hots);
        let of_tokens = mat.decoder.first().map(|block| block.self_attention.project(tape, tokens, tokens));
        let caches = mat.decoder.iter().map(|block| Cache::of(block, tape, encoded.rows)).collect();
        Self { mat, encoded, tokens, of_tokens, caches }
    }

    /// Logits of one place's rows, given their tokens.
    fn decide<'a>(&self, tape: &mut Tape<'a>, place: &'a Place, tokens: &[usize]) -> Var {
        let mut x = pick(tape, self.tokens, tokens);
        let own = pick(tape, self.encoded, &place.rows);
        let mut of_tokens = self.of_tokens.map(|Projected { queries, key_values }| Projected {
            queries: pick(tape, queries, tokens),
            key_values: pick(tape, key_values, tokens),
        });
        for (block, cache) in self.mat.decoder.iter().zip(&self.caches) {
            let of_tokens = of_tokens.take();
            let projected = of_tokens.unwrap_or_else(|| block.self_attention.project(tape, x, x));
            x = cache.forward(block, tape, x, projected, own, place);
        }
        let logits = self.mat.head.forward(tape, x);
        tape.free(x);
        tape.free(own);
        logits
    }
}

/// A block's keys and values of the rows so far, (R, 2e) each.
struct Cache {
    itself: Var,
    cross: Var,
}

impl Cache {
    fn of(block: &DecoderBlock, tape: &mut Tape<'_>, rows: usize) -> Self {
        let mut reserve = |attention: &MultiHead| tape.reserve(rows, 2 * attention.attention.dim);
        Self { itself: reserve(&block.self_attention), cross: reserve(&block.cross_attention) }
    }

    /// The block over one place's rows: `x`, its projections, and what the encoder made of the rows, `own`.
    fn forward<'a>(
        &self,
        block: &DecoderBlock,
        tape: &mut Tape<'a>,
        x: Var,
        projected: Projected,
        own: Var,
        place: &'a Place,
    ) -> Var {
        let attended = attend(&block.self_attention, tape, projected, self.itself, place);
        let y = normalized_sum(tape, &block.norm1, x, attended);
        tape.free(x);
        let projected = block.cross_attention.project(tape, own, y);
        tape.free(y);
        let attended = attend(&block.cross_attention, tape, projected, self.cross, place);
        block.finish(tape, own, attended)
    }
}

/// Attention of one place's rows to those of their teams so far, whose keys and values join the `cache`.
fn attend<'a>(
    layer: &MultiHead,
    tape: &mut Tape<'a>,
    projected: Projected,
    cache: Var,
    place: &'a Place,
) -> Var {
    let new = projected.key_values;
    tape.write_into(cache, |values, mut cache, _| {
        for (at, &row) in place.rows.iter().enumerate() {
            cache.row(row).copy_from_slice(values.view(new).row(at));
        }
    });
    tape.free(new);
    layer.attend(tape, Projected { key_values: cache, ..projected }, &place.groups, Visible::All)
}

/// y row i = x row `rows[i]`, without a gradient.
fn pick(tape: &mut Tape<'_>, x: Var, rows: &[usize]) -> Var {
    let mut y = tape.take(rows.len() * x.cols);
    for (to, &from) in y.chunks_exact_mut(x.cols).zip(rows) {
        to.copy_from_slice(tape.view(x).row(from));
    }
    tape.push(y, x.cols)
}
