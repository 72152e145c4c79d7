// Types that the modules of the pages share. Those of answers and bodies are the API's description's, those of elements the page's own:
// scripts/check-pages writes both.

import type { components, paths } from "written/answers";
import type { paths as taking } from "written/bodies"; // what has a default may be left out
import type { Elements as Ids } from "written/elements";

type Segments<Path extends string> = Path extends `${infer First}/${infer Rest}` ? [First, ...Segments<Rest>] : [Path];

/** Whether the segments that are asked for are those of a route; `{name}` in a route stands for any. */
type Fits<Asked extends string[], Route extends string[]> = Route extends [infer Own extends string, ...infer Owns extends string[]]
  ? Asked extends [infer One extends string, ...infer Others extends string[]]
    ? Own extends `{${string}}`
      ? Fits<Others, Owns>
      : One extends Own
        ? Fits<Others, Owns>
        : false
    : false
  : Asked extends []
    ? true
    : false;

type Bare<Path extends string> = Path extends `${infer Before}?${string}` ? Before : Path;

/** The operation of a method and a path, its query left out; `never` where the service has none. */
type Operation<Method extends string, Path extends string, Of = paths> = Path extends string
  ? {
      [Route in keyof Of]: Route extends `/api/v1${infer Own}`
        ? Fits<Segments<Bare<Path>>, Segments<Own>> extends true
          ? Method extends keyof Of[Route]
            ? NonNullable<Of[Route][Method]>
            : never
          : never
        : never;
    }[keyof Of]
  : never;

type Json<Of> = Of extends { content: { "application/json": infer Body } } ? Body : null;

declare global {
  type Model<Name extends keyof components["schemas"]> = components["schemas"][Name];
  type Elements = Ids;

  interface DocumentEventMap {
    "logged-out": Event;
    connection: CustomEvent<boolean>;
    "session-progress": CustomEvent<{ id: string; words: string; done: number; total: number; asks?: Model<"Question"> | null }>;
  }

  type Scope = Model<"Me">["scope"];
  type Safety = Model<"StationSafety">;
  type Side = "left" | "right";
  /** A session or a recording set, as its path has it. */
  type Source = { kind: "sessions" | "recordings"; id: string };

  /** What the service answers to a method on a path where all goes well. */
  type Answer<Method extends string, Path extends string> =
    Operation<Method, Path> extends infer Of
      ? Of extends { responses: infer Told }
        ? { [Status in keyof Told]: Status extends 200 | 201 | 202 | 204 ? Json<Told[Status]> : never }[keyof Told]
        : never
      : never;

  /** What the service takes with a method on a path. */
  type Taken<Method extends string, Path extends string> =
    Operation<Method, Path, taking> extends infer Of
      ? Of extends { requestBody: infer Body }
        ? Json<Body>
        : Of extends { requestBody?: infer Body }
          ? (NonNullable<Body> extends never ? never : Json<NonNullable<Body>>) | undefined
          : undefined
      : never;

  /** A path that the service has for a method; any other one is an error of types. */
  type Known<Method extends string, Path extends string> = Path & ([Operation<Method, Path>] extends [never] ? never : unknown);

  type Get = <const Path extends string>(path: Known<"get", Path>) => Promise<Answer<"get", Path>>;
  type Delete = <const Path extends string>(path: Known<"delete", Path>) => Promise<Answer<"delete", Path>>;
  type Send<Method extends string> = <const Path extends string>(
    path: Known<Method, Path>,
    ...body: undefined extends Taken<Method, Path> ? [body?: Taken<Method, Path>] : [body: Taken<Method, Path>]
  ) => Promise<Answer<Method, Path>>;
}
