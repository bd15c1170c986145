use super::*;
use crate::gradcheck::{check, noise};

const H: usize = 5;
const A: usize = 4;
const F: usize = 7;
/// Time 0: two agents among three entities, one agent among two; time 1: the first two go on.
const GROUP_TIMES: [usize; 3] = [0, 2, 3];
const AGENT_TIMES: [usize; 3] = [0, 3, 5];
const ROWS: usize = 5;
const ENTITIES: usize = 8;

fn groups() -> [Group; 3] {
    [
        Group { queries: 0..2, keys: 0..3 },
        Group { queries: 2..3, keys: 3..5 },
        Group { queries: 3..5, keys: 5..8 },
    ]
}

/// Agent 1 does not see itself at time 0, agent 2 sees nothing, agent 0 sees nothing at time 1.
const SEEN: [u8; 14] = [1, 1, 0, 1, 0, 1, 0, 0, 0, 0, 0, 1, 1, 1];

fn block(heads: usize) -> (HiddenToken, usize) {
    let mut layout = LayoutBuilder::default();
    let block = HiddenToken::new(&mut layout, "utility", H, A, heads, F);
    (block, layout.len())
}

fn places<'a>(groups: &'a [Group], visible: Visible<'a>) -> Places<'a> {
    Places { groups, group_times: &GROUP_TIMES, agent_times: &AGENT_TIMES, visible }
}

/// What a pass says, and what it leaves.
struct Run {
    own: Vec<f32>,
    history: Vec<f32>,
    state: HiddenTokenState,
}

fn pass(
    block: &HiddenToken,
    params: &[f32],
    places: Places<'_>,
    x: View<'_>,
    before: Option<View<'_>>,
) -> Run {
    let (mut own, mut history) = (vec![9.0; places.rows() * H], vec![9.0; places.rows() * H]);
    let stock = &mut Scratch::default();
    let state = block.forward(params, places, x, before, &mut own, &mut history, stock);
    Run { own, history, state }
}

fn run(block: &HiddenToken, params: &[f32], x: &[f32], visible: Visible<'_>) -> Run {
    pass(block, params, places(&groups(), visible), View::dense(x, H), None)
}

/// One agent, one token after another: what its own token and its hidden token become.
fn reference(block: &HiddenToken, params: &[f32], own: &[f32], tokens: &[&[f32]]) -> [Vec<f32>; 2] {
    let project = |x: &[f32]| {
        let (mut q, mut kv) = (vec![0.0; A], vec![0.0; 2 * A]);
        block.attention.query.forward(params, View::dense(x, H), ViewMut::dense(&mut q, A));
        block.attention.key_value.forward(params, View::dense(x, H), ViewMut::dense(&mut kv, 2 * A));
        (q, kv)
    };
    let head_dim = A / block.attention.heads;
    let asked: Vec<Vec<f32>> = tokens.iter().map(|token| project(token).1).collect();
    [own, tokens[tokens.len() - 1]].map(|u| {
        let q = project(u).0;
        let attended: Vec<f32> = (0..A)
            .map(|column| {
                let head = column / head_dim * head_dim..(column / head_dim + 1) * head_dim;
                let weight = |kv: &[f32]| -> f32 {
                    let score: f32 = head.clone().map(|c| q[c] * kv[c]).sum();
                    (score / (head_dim as f32).sqrt()).exp()
                };
                let total: f32 = asked.iter().map(|kv| weight(kv)).sum();
                asked.iter().map(|kv| weight(kv) * kv[A + column].max(0.0)).sum::<f32>() / total
            })
            .collect();
        let mut state = block.post_norm.state(1, &mut Scratch::default());
        let mut out = vec![0.0; H];
        let (u, attended) = (View::dense(u, H), View::dense(&attended, A));
        block.post_norm.forward(params, 0..1, u, attended, &mut state, ViewMut::dense(&mut out, H));
        out
    })
}

#[test]
fn is_a_transformer_over_what_is_seen_and_the_hidden_token() {
    for heads in [1, 2] {
        let (block, len) = block(heads);
        let (params, x) = (noise(1, len), noise(2, ENTITIES * H));
        let said = run(&block, &params, &x, Visible::Where(&SEEN));
        let token = |entity: usize| &x[entity * H..][..H];
        let none = vec![0.0; H];
        // Agent rows with their own token, what they see, and the row one time before.
        let rows: [(usize, &[usize], Option<usize>); ROWS] = [
            (0, &[0, 1], None),
            (1, &[0, 2], None),
            (3, &[], None),
            (5, &[], Some(0)),
            (6, &[5, 6, 7], Some(1)),
        ];
        let mut history: Vec<Vec<f32>> = vec![];
        for (row, (own, seen, before)) in rows.into_iter().enumerate() {
            let hidden = before.map_or(none.clone(), |before| history[before].clone());
            let mut tokens: Vec<&[f32]> = seen.iter().map(|&entity| token(entity)).collect();
            tokens.push(&hidden);
            let [of_own, of_hidden] = reference(&block, &params, token(own), &tokens);
            for (ours, theirs) in [(&said.own, &of_own), (&said.history, &of_hidden)] {
                for (a, b) in ours[row * H..][..H].iter().zip(theirs) {
                    assert!((a - b).abs() < 1e-5, "{heads} heads, row {row}: {a} {b}");
                }
            }
            history.push(of_hidden);
        }
    }
}

#[test]
fn one_time_at_a_time_is_the_same_to_the_bit() {
    let (block, len) = block(2);
    let (params, x) = (noise(1, len), noise(2, ENTITIES * H));
    let all = run(&block, &params, &x, Visible::Where(&SEEN));
    let mut before: Option<Vec<f32>> = None;
    let [a, b, c] = groups();
    let again = [Group { queries: 0..c.queries.len(), keys: 0..c.keys.len() }];
    for (groups, entities, rows, seen) in [(&[a, b][..], 0..5, 0..3, 0..8), (&again[..], 5..8, 3..5, 8..14)] {
        let places = Places {
            groups,
            group_times: &[0, groups.len()],
            agent_times: &[0, rows.len()],
            visible: Visible::Where(&SEEN[seen]),
        };
        let before_view = before.as_ref().map(|before| View::dense(before, H).rows(0..rows.len()));
        let said = pass(&block, &params, places, View::dense(&x, H).rows(entities), before_view);
        assert_eq!(said.own, all.own[rows.start * H..rows.end * H]);
        assert_eq!(said.history, all.history[rows.start * H..rows.end * H]);
        before = Some(said.history);
    }
}

#[test]
fn gradients_are_the_numeric_ones() {
    for (heads, visible) in [(1, Visible::All), (2, Visible::Where(&SEEN))] {
        let (block, len) = block(heads);
        let (params, x, to) = (noise(1, len), noise(2, ENTITIES * H), noise(3, ROWS * H));
        let loss = |params: &[f32], x: &[f32]| {
            let said = run(&block, params, x, visible);
            said.own.iter().zip(&to).map(|(own, to)| f64::from(own * to)).sum()
        };
        let said = run(&block, &params, &x, visible);
        let (mut grads, mut dx) = (vec![0.0; len], vec![9.0; x.len()]);
        block.backward(
            &params,
            places(&groups(), visible),
            View::dense(&x, H),
            &said.state,
            View::dense(&to, H),
            ViewMut::dense(&mut dx, H),
            &mut grads,
            &mut Scratch::default(),
        );
        check("params", &params, &grads, |params| loss(params, &x));
        check("x", &x, &dx, |x| loss(&params, x));
    }
}
